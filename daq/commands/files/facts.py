"""Content of a log, as `rotorscope info` prints it."""

from __future__ import annotations

from typing import Any

from daq.base.contract.dates import utc_text
from daq.log.reader import Recording


def info(log: Recording) -> dict[str, Any]:
    """As schemas/info.json, and more."""
    out: dict[str, Any] = {
        "schema": 1,
        "log": str(log.path),
        "started": None if log.started_ns is None else utc_text(log.started_ns),
        "seconds": log.seconds,
        "rate_hz": log.rate_hz,
        "channels": list(log.channels),
        "units": [s.unit for s in log.info.signals],
        "first_index": log.first,
        "samples": log.n_samples,
        "lost_samples": log.lost_samples,
        "gaps": [{"index": g.index, "count": g.count, "reason": g.reason} for g in log.gaps],
        "left_out": [{"index": o.index, "count": o.samples, "reason": o.what} for o in log.others[:100]],
        "complete": log.complete,
        "being_written": log.growing,
        "damage": list(log.damage),
        "device": {"name": log.head.device, "serial_number": log.info.serial_number, "count_bits": log.info.count_bits},
        "estimates": len(log.estimates),
        "last_estimate": {n: p.to_json() for n, p in log.estimates[-1].estimate.parameters.items()}
        if log.estimates
        else {},
        "notices": [{"level": n.level, "code": n.code, "text": n.text} for n in log.notices[-100:]],
        "attachments": {name: len(data) for name, data in log.attachments.items()},
        "metadata": log.metadata,
    }
    if log.from_s is not None:
        out["from_s"] = log.from_s
    if log.clock is not None:
        out["clock"] = {"offset_bound_s": log.clock.bound_ns * 1e-9, "drift_ppm": log.clock.drift_ppm}
    if log.last_status is not None:
        link = log.last_status.link
        out["link"] = {
            "frames": link.frames,
            "crc_errors": link.crc_errors,
            "resyncs": link.resyncs,
            "reconnects": link.reconnects,
        }
        out["dropped"] = dict(log.last_status.dropped)
    return out
