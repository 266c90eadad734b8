"""Alarms on a real broker on loopback: retained, published again after a reconnect, never waited for."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from promises import PATIENCE_S, until, within

from daq.base.contract.errors import ConfigError
from daq.trend.alarms.mqtt import MqttAlarms
from daq.trend.alarms.watch import AlarmState

ANSWER_S = 0.3
BROKER = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")
needs_broker = pytest.mark.skipif(BROKER is None, reason="mosquitto is not installed")
STATE = AlarmState(what="bearing1.x.kL", state="alarm", value=9.5e6, sd=1e4, unit="N/m", since_ns=10**18, text="a ±")


class Broker:
    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self._conf = folder / "mosquitto.conf"
        self._conf.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\n")
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen([str(BROKER), "-c", str(self._conf)], stderr=subprocess.DEVNULL)

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(PATIENCE_S)

    def retained(self, wanted: int) -> dict[str, Any]:
        """Messages to a late subscriber, once so many topics are known."""
        end = time.monotonic() + PATIENCE_S
        while len(found := self._retained()) < wanted:
            assert time.monotonic() < end, found
        return found

    def _retained(self) -> dict[str, Any]:
        import paho.mqtt.client as mqtt

        found: dict[str, Any] = {}
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        client.on_message = lambda c, d, m: found.__setitem__(m.topic, m.payload.decode()) if m.retain else None
        client.on_connect = lambda c, *_: c.subscribe("#")
        client.connect("127.0.0.1", self.port)
        end = time.monotonic() + ANSWER_S
        while time.monotonic() < end:
            client.loop(0.05)
        client.disconnect()
        return found


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    own = Broker(tmp_path)
    yield own
    own.stop()


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@needs_broker
def test_alarms_are_retained_and_the_end_is_reported(broker: Broker) -> None:
    broker.start()
    until(lambda: listens(broker.port))
    alarms = MqttAlarms(f"mqtt://127.0.0.1:{broker.port}/plant/hall 3")
    alarms.listener("press/1")(STATE)
    topic = "plant/hall 3/press_1/alarm/bearing1.x.kL"
    found = broker.retained(2)
    assert found["plant/hall 3/status"] == "online"
    value = json.loads(found[topic])
    assert (value["schema"], value["state"], value["value"], value["text"]) == (1, "alarm", 9.5e6, "a ±")
    assert value["since"] == "2001-09-09T01:46:40.000000Z"
    alarms.close()
    assert broker.retained(2)["plant/hall 3/status"] == "offline"


@pytest.mark.slow
@needs_broker
def test_a_broker_that_comes_later_is_given_all_states(broker: Broker) -> None:
    begin = time.monotonic()
    alarms = MqttAlarms(f"mqtt://127.0.0.1:{broker.port}")
    alarms.listener("press")(STATE)
    within(time.monotonic() - begin, 0.5)
    broker.start()
    until(lambda: listens(broker.port))
    assert json.loads(broker.retained(2)["rotorscope/press/alarm/bearing1.x.kL"])["state"] == "alarm"
    alarms.close()


def test_a_broker_that_is_not_there_holds_nothing(broker: Broker) -> None:
    said: list[str] = []
    alarms = MqttAlarms(f"mqtt://127.0.0.1:{broker.port}", said.append)
    alarms.listener("press")(STATE)
    until(lambda: len(said) > 0)
    time.sleep(1.5)  # it is tried again after a second
    begin = time.monotonic()
    alarms.close()
    within(time.monotonic() - begin, 2.5)
    assert said == [f"MQTT broker 127.0.0.1:{broker.port}: cannot be reached; it is tried again"]


@pytest.mark.parametrize("url", ["http://a", "mqtt://", "mqtt://a:port", "mqtt://me:secret@a"])
def test_a_wrong_url_is_one_line(url: str) -> None:
    with pytest.raises(ConfigError, match="--mqtt") as caught:
        MqttAlarms(url)
    assert "secret" not in str(caught.value)


def test_a_missing_library_is_one_line_with_what_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", None)
    with pytest.raises(ConfigError, match=r"--mqtt: needs paho.* pip install 'rotorscope\[monitor\]'"):
        MqttAlarms("mqtt://a")
