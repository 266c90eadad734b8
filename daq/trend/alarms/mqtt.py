"""Alarms to an MQTT broker: one retained JSON message for each alarm, so that a later subscriber knows its state."""

from __future__ import annotations

import json
import os
import threading
import uuid
from collections.abc import Callable
from typing import Any
from urllib.parse import unquote, urlsplit

from daq.base.console.extras import required
from daq.base.console.output import finite
from daq.base.contract.errors import ConfigError

from .watch import AlarmState

PASSWORD_VARIABLE = "ROTORSCOPE_MQTT_PASSWORD"  # noqa: S105
MQTT_PORT, MQTTS_PORT = 1883, 8883
KEEPALIVE_S = 30  # a broker notices a lost client within one and a half of these
RECONNECT_S = (1, 60)  # first and longest wait
MAX_QUEUED = 1000  # messages that wait for a broker; the states are published anew at each connection
CLOSE_S = 2.0
AT_LEAST_ONCE = 1  # quality of service
FORBIDDEN_IN_TOPIC = str.maketrans({"/": "_", "+": "_", "#": "_", "\0": "_"})


class MqttAlarms:
    """A connection to a broker. A missing broker is tried again for ever; no caller waits for it.

    url : mqtt://[USER@]HOST[:PORT][/PREFIX], or mqtts: with TLS; the password is in the environment. note : called,
    from another thread, with one line when the broker refuses or is lost. Raises ConfigError for a URL that is none.
    """

    def __init__(self, url: str, note: Callable[[str], None] = lambda text: None) -> None:
        mqtt = required("paho.mqtt.client", "monitor", "--mqtt")
        parts = urlsplit(url)
        try:
            port = parts.port
        except ValueError:
            port = -1
        if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or port == -1:
            raise ConfigError(f"--mqtt {url}: give mqtt://[USER@]HOST[:PORT][/PREFIX], or mqtts:// for TLS")
        if parts.password is not None:
            raise ConfigError(f"--mqtt: a password in the URL is seen by others: set {PASSWORD_VARIABLE} instead")
        secure = parts.scheme == "mqtts"
        self._prefix = parts.path.strip("/") or "rotorscope"
        self._target = f"{parts.hostname}:{port or (MQTTS_PORT if secure else MQTT_PORT)}"
        self._note, self._connected, self._missed = note, False, False
        self._states: dict[str, AlarmState] = {}
        self._lock = threading.Lock()
        self._client: Any = mqtt.Client(
            mqtt.CallbackAPIVersion.VERSION2, client_id=f"rotorscope-{uuid.uuid4().hex[:12]}"
        )
        self._client.max_queued_messages_set(MAX_QUEUED)
        self._client.reconnect_delay_set(*RECONNECT_S)
        self._client.will_set(f"{self._prefix}/status", "offline", AT_LEAST_ONCE, retain=True)
        if parts.username:
            self._client.username_pw_set(unquote(parts.username), os.environ.get(PASSWORD_VARIABLE))
        if secure:
            self._client.tls_set()
        self._client.on_connect, self._client.on_disconnect = self._on_connect, self._on_disconnect
        self._client.on_connect_fail = self._on_connect_fail
        self._client.connect_async(parts.hostname, port or (MQTTS_PORT if secure else MQTT_PORT), KEEPALIVE_S)
        self._client.loop_start()

    def listener(self, device: str) -> Callable[[AlarmState], None]:
        """The function that publishes the alarms of a device."""

        def publish(state: AlarmState) -> None:
            own, what = (text.translate(FORBIDDEN_IN_TOPIC) for text in (device, state.what))
            topic = f"{self._prefix}/{own}/alarm/{what}"
            with self._lock:
                self._states[topic] = state
            if self._connected:
                self._publish(topic, state)

        return publish

    def close(self) -> None:
        """Publish the end of the service, and disconnect; at most two seconds."""
        leaving = threading.Thread(target=self._leave, name="mqtt", daemon=True)
        leaving.start()
        leaving.join(CLOSE_S)

    def _leave(self) -> None:
        if self._connected:
            self._client.publish(f"{self._prefix}/status", "offline", AT_LEAST_ONCE, retain=True).wait_for_publish(
                CLOSE_S / 2
            )
        self._client.disconnect()
        self._client.loop_stop()

    def _publish(self, topic: str, state: AlarmState) -> None:
        text = json.dumps(finite(state.to_json()), allow_nan=False, ensure_ascii=False)
        self._client.publish(topic, text, AT_LEAST_ONCE, retain=True)

    def _on_connect(self, client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            self._note(f"MQTT broker {self._target}: {reason}; it is tried again")
            return
        self._connected, self._missed = True, False
        client.publish(f"{self._prefix}/status", "online", AT_LEAST_ONCE, retain=True)
        with self._lock:
            known = dict(self._states)
        for topic, state in known.items():
            self._publish(topic, state)

    def _on_connect_fail(self, client: Any, data: Any) -> None:
        """Report once that the broker does not answer, until it is reached."""
        if not self._missed:
            self._note(f"MQTT broker {self._target}: cannot be reached; it is tried again")
        self._missed = True

    def _on_disconnect(self, client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        if self._connected and reason.is_failure:
            self._note(f"MQTT broker {self._target}: {reason}; it is tried again")
            self._missed = True
        self._connected = False
