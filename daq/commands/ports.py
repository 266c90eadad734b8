"""`rotorscope ports`: links that can be opened here, and libraries that are missing."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from daq.base.console.output import Output

# python-can's interfaces -> (what they are, the module or library that must be there, where it comes from)
CAN_INTERFACES = {
    "socketcan": ("Linux kernel CAN", "", "a Linux kernel with CAN drivers"),
    "socketcand": ("CAN over TCP", "", "a socketcand server: can:socketcand:can0?host=..&port=.."),
    "udp_multicast": ("CAN frames over UDP multicast", "msgpack", "pip install msgpack"),
    "gs_usb": ("candleLight, CANable with gs_usb", "gs_usb", "pip install gs_usb"),
    "pcan": ("PEAK PCAN-USB", "", "PEAK's PCAN-Basic library"),
    "kvaser": ("Kvaser", "", "Kvaser's CANlib"),
    "vector": ("Vector", "", "Vector's XL driver library"),
    "ixxat": ("HMS Ixxat", "", "Ixxat's VCI driver"),
}
ARPHRD_CAN = "280"


def ports(output: Output) -> None:
    found = [*serial_ports(), *can_links(), *configured()]
    missing = absent()
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("link", no_wrap=True)
    table.add_column("what it is", overflow="fold")
    for row in found:
        table.add_row(Text(row["link"]), Text(row["what"]))
    table.add_row("virtual:", "a simulated device on an in-process CAN bus; always there")
    people: list[Any] = [table]
    if not any(row["link"].startswith(("serial:", "slcan:")) for row in found):
        people.append(f"no serial port: {_serial_advice()}")
    people += [f"missing: {m['what']}: {m['needs']}" for m in missing]
    virtual = {"link": "virtual:", "what": "a simulated device on an in-process CAN bus"}
    output.result({"schema": 1, "links": [*found, virtual], "missing": missing}, *people)


def serial_ports() -> list[dict[str, str]]:
    """Serial ports, each as a link for our own frames and for an slcan adapter."""
    from serial.tools import list_ports

    out = []
    for port in sorted(list_ports.comports()):
        what = " ".join(t for t in (port.description, port.manufacturer) if t and t != "n/a") or "serial port"
        busy = "" if _readable(port.device) else "; no permission: join the group dialout (or uucp)"
        out.append({"link": f"serial:{port.device}", "what": what + busy})
        out.append({"link": f"slcan:{port.device}", "what": f"the same, if it is an slcan adapter{busy}"})
    return out


def _readable(device: str) -> bool:
    import os

    return sys.platform == "win32" or os.access(device, os.R_OK | os.W_OK)


def _serial_advice() -> str:
    return "plug the adapter in; in a container, pass the device on" if sys.platform == "linux" else "plug it in"


def can_links() -> list[dict[str, str]]:
    """SocketCAN network interfaces and their state."""
    out = []
    for folder in sorted(Path("/sys/class/net").glob("*")):
        try:
            if (folder / "type").read_text().strip() != ARPHRD_CAN:
                continue
            state = (folder / "operstate").read_text().strip()
            fd = int((folder / "mtu").read_text()) >= 72
        except (OSError, ValueError):
            continue
        name = folder.name
        down = "" if state in ("up", "unknown") else f"; {state}: ip link set {name} up type can bitrate 1000000"
        out.append({"link": f"can:socketcan:{name}{'?fd=1' if fd else ''}", "what": f"SocketCAN {name}{down}"})
    return out


def configured() -> list[dict[str, str]]:
    """Adapters that python-can's interfaces find by themselves."""
    import logging

    import can

    logging.getLogger("can").setLevel(logging.CRITICAL)
    out = []
    for name in ("pcan", "kvaser", "vector", "ixxat", "gs_usb", "neovi", "usb2can", "systec", "canalystii"):
        try:
            configs = can.detect_available_configs(interfaces=[name])
        except Exception:  # noqa: BLE001, S112 - a vendor's library that is half installed; its absence is reported below
            continue
        out += [{"link": f"can:{name}:{c['channel']}", "what": f"{name} adapter"} for c in configs if "channel" in c]
    return out


def absent() -> list[dict[str, str]]:
    """Interfaces that could be used here if something were installed."""
    out = []
    for name, (what, module, needs) in CAN_INTERFACES.items():
        if name == "socketcan":
            gone = sys.platform != "linux" or not _af_can()
        else:
            gone = bool(module) and importlib.util.find_spec(module) is None
        if gone:
            out.append({"what": f"{name} ({what})", "needs": needs})
    return out


def _af_can() -> bool:
    import socket

    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True
