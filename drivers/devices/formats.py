"""Packets of makers, from their public descriptions.

WitMotion, standard protocol: 0x55, type, four 16-bit numbers, sum of the ten bytes before it.
MicroStrain MIP: "ue", descriptor set, length, fields (length, descriptor, data), Fletcher check sum of 16 bits.
Epson M-A352, UART burst with flags, temperature, three accelerations of 32 bits, count and check sum, all high byte
first: 0x80 ... 0x0D; the check sum is the sum of the 16-bit words between header and check sum.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.can.can_frames import EXTENDED_FLAG, CanFrames

from .packets import Format, I64Array, U8Array, frames_of, sums

WIT_BYTES, WIT_FIRST_TYPE, WIT_LAST_TYPE = 11, 0x50, 0x5F
MIP_HEAD, MIP_FRAME = 4, 6  # bytes before the fields; and with the check sum
EPSON_BYTES, EPSON_ADDRESS, EPSON_END = 24, 0x80, 0x0D


def _wit_lengths(data: U8Array, starts: I64Array) -> I64Array:
    return np.full(len(starts), WIT_BYTES, np.int64)


def _wit_sound(data: U8Array, starts: I64Array, ends: I64Array) -> NDArray[np.bool_]:
    kind, before = data[starts + 1], sums(data)
    known = (kind >= WIT_FIRST_TYPE) & (kind <= WIT_LAST_TYPE)
    return np.asarray(known & ((before[ends - 1] - before[starts]) % 256 == data[ends - 1]))


def _wit_split(data: U8Array, starts: I64Array, ends: I64Array) -> tuple[CanFrames, I64Array]:
    return frames_of(data[starts + 1].astype(np.uint32), data, starts + 2, 8), np.arange(len(starts))


def _mip_lengths(data: U8Array, starts: I64Array) -> I64Array:
    return data[starts + 3].astype(np.int64) + MIP_FRAME


def _mip_sound(data: U8Array, starts: I64Array, ends: I64Array) -> NDArray[np.bool_]:
    """Fletcher: the sum of the bytes, and the sum of these sums."""
    one = sums(data)
    two = np.concatenate([[0], np.cumsum(one[1:])])
    stop = ends - 2
    low = one[stop] - one[starts]
    high = two[stop] - two[starts] - (stop - starts) * one[starts]
    return np.asarray((low % 256 == data[stop]) & (high % 256 == data[stop + 1]))


def _mip_split(data: U8Array, starts: I64Array, ends: I64Array) -> tuple[CanFrames, I64Array]:
    """A frame for each field; packets of one layout together. Identifier: descriptor set * 256 + descriptor."""
    parts: list[CanFrames] = []
    of: list[I64Array] = []
    left = np.arange(len(starts))
    while len(left):
        first = int(starts[left[0]])
        fields = _mip_fields(data, first, int(ends[left[0]]) - 2)
        same = ends[left] - starts[left] == ends[left[0]] - starts[left[0]]
        same &= data[starts[left] + 2] == data[first + 2]
        for at, _ in fields:
            here = starts[left[same]] + at
            same[same] = (data[here] == data[first + at]) & (data[here + 1] == data[first + at + 1])
        rows = left[same]
        for at, length in fields:
            begin = starts[rows] + at
            ids = data[starts[rows] + 2].astype(np.uint32) * 256 + data[begin + 1] + np.uint32(EXTENDED_FLAG)
            parts.append(frames_of(ids.astype(np.uint32), data, begin + 2, length - 2))
            of.append(rows)
        left = left[~same]
    if not parts:
        return frames_of(np.zeros(0, np.uint32), data, np.zeros(0, np.int64), 0), np.zeros(0, np.int64)
    packet = np.concatenate(of)
    order = np.argsort(packet, kind="stable")
    joined = CanFrames(
        np.concatenate([p.ids for p in parts])[order], np.concatenate([p.lengths for p in parts])[order],
        np.concatenate([p.payload for p in parts])[order], np.concatenate([p.t_ns for p in parts])[order],
    )  # fmt: skip
    return joined, packet[order]


def _mip_fields(data: U8Array, start: int, stop: int) -> list[tuple[int, int]]:
    """Offset and length of the fields of a packet; what is behind a wrong length is left out."""
    out, at = [], start + MIP_HEAD
    while at + 2 <= stop and 2 <= int(data[at]) <= stop - at:
        out.append((at - start, int(data[at])))
        at += int(data[at])
    return out


def _epson_lengths(data: U8Array, starts: I64Array) -> I64Array:
    return np.full(len(starts), EPSON_BYTES, np.int64)


def _epson_sound(data: U8Array, starts: I64Array, ends: I64Array) -> NDArray[np.bool_]:
    words = starts[:, None] + 1 + 2 * np.arange((EPSON_BYTES - 2) // 2)
    value = data[words].astype(np.int64) * 256 + data[words + 1]
    right = value[:, :-1].sum(axis=1) % 65536 == value[:, -1]
    return np.asarray(right & (data[ends - 1] == EPSON_END))


def _epson_split(data: U8Array, starts: I64Array, ends: I64Array) -> tuple[CanFrames, I64Array]:
    ids = np.full(len(starts), EPSON_ADDRESS, np.uint32)
    return frames_of(ids, data, starts + 1, EPSON_BYTES - 2), np.arange(len(starts))


WITMOTION_FORMAT = Format(sync=b"\x55", head=2, lengths=_wit_lengths, sound=_wit_sound, split=_wit_split)
MIP_FORMAT = Format(sync=b"\x75\x65", head=4, lengths=_mip_lengths, sound=_mip_sound, split=_mip_split)
EPSON_FORMAT = Format(sync=b"\x80", head=1, lengths=_epson_lengths, sound=_epson_sound, split=_epson_split)
