"""A whole log from a cut or damaged one, message by message, bit for bit."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.base.contract.errors import LogError
from drivers.contract import Gap, Notice

from . import codec as codec
from .encoder import LogEncoder
from .entries import walk
from .file import LogFile
from .reader import Recording, read_log
from .scan import Message

FLUSH_MESSAGES = 1000


@dataclass(frozen=True, slots=True)
class Recovery:
    """The samples that a recovery saved. lost : a sentence for the user."""

    samples: int
    seconds: float
    lost: str

    def to_json(self) -> dict[str, Any]:
        """As schemas/recover.json."""
        return {
            "schema": 1,
            "samples_recovered": self.samples,
            "seconds_recovered": self.seconds,
            "lost": self.lost,
        }


def recover(
    source: str | Path, target: str | Path, progress: Callable[[float], None] | None = None,
    note: Callable[[str], None] | None = None,
) -> Recovery:  # fmt: skip
    """Write the intact messages of `source` to `target`, with index and footer; missing samples become gaps.

    progress : called with the share that is done. note : called with each further remark.
    Raises LogError if nothing is intact, or `target` is `source`.
    """
    source, target = Path(source), Path(target)
    if target.exists() and os.path.samefile(source, target):
        raise LogError(f"{target}: is the log to be recovered; choose another --out")
    recording = read_log(source)
    file = LogFile(target, whole=True)
    encoder = LogEncoder(file)
    lost = _lost(recording)
    last = Message(0, 0, 0, b"")
    try:
        for name, (media_type, data) in recording.findings.attachments.items():
            encoder.attachment(name, media_type, data)
        encoder.metadata("session", recording.metadata | {"device": recording.head.device})
        span = max(1, recording.stop - recording.first)
        for number, (entry, message) in enumerate(walk(source, recording.again(), everything=True)):
            if message is None and isinstance(entry, Gap):
                message = Message(codec.GAP_CHANNEL, last.log_time, last.publish_time, codec.encode_gap(entry))
            if message is not None and message.channel > len(codec.LOG_TOPICS):  # for viewers
                encoder.raw_viewer_message(recording.findings.topics[message.channel], *message[1:])
            elif message is not None:
                encoder.raw_message(*message)
                last = message
            if number % FLUSH_MESSAGES == 0:
                encoder.flush()
                file.push()
            if progress is not None and isinstance(entry, codec.RawBlock):
                progress((entry.stop - recording.first) / span)
        _say(encoder, recording, last.log_time, f"recovered from {source.name}; lost: {lost}")
        encoder.finish()
        file.push()
        file.keep()
    except OSError as error:
        reason = error.strerror or error
        raise LogError(f"{target}: cannot be written: {reason}; make room, or choose another --out") from error
    finally:
        file.close()
    if file.kept is not None and note is not None:
        note(f"{target}: what lay there is kept as {file.kept}")
    return Recovery(recording.n_samples, recording.n_samples / recording.rate_hz, lost)


def _say(encoder: LogEncoder, recording: Recording, wall_ns: int, text: str) -> None:
    notice = Notice(wall_ns - recording.head.wall_offset_ns, "info", "recovered", text)
    encoder.raw_message(codec.NOTICE_CHANNEL, wall_ns, wall_ns, codec.encode_notice(notice, wall_ns))


def _lost(recording: Recording) -> str:
    if recording.complete:
        return "nothing: the log was complete and intact"
    holes = [g for g in recording.gaps if g.reason == "log"]
    parts = []
    if holes:
        named = ", ".join(f"{g.count} from {g.index}" for g in holes[:5]) + (", ..." if len(holes) > 5 else "")
        parts.append(f"{sum(g.count for g in holes)} samples in {len(holes)} damaged places ({named})")
    if recording.growing:
        parts.append(f"what comes after sample {recording.stop - 1}: the log is still being written")
    elif not recording.findings.closed:
        much = (
            "at most the last second if the program or its computer was stopped, more if the disk was full or the file"
        )
        much += " was cut later"
        parts.append(f"what came after sample {recording.stop - 1}: {much}")
    if "rig.toml" not in recording.attachments:
        parts.append("the rig file")
    if not parts:
        parts.append("no sample; only the index of the file was damaged")
    return "; ".join(parts)
