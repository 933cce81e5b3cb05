"""Network captures, pcap and pcapng: reads UDP datagrams and reassembles IP fragments.

No library is used: dpkt parses one packet at a time and does not reassemble fragments, and a scan of an Ouster sensor comes
in about a thousand of them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Longs
from lslam.core.errors import InputError, UsageError, input_errors
from lslam.io.remote import RemotePath

# First bytes of a pcap: byte order, and ns per unit of the second word of its times.
_PCAP = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
_PCAPNG = b"\x0a\x0d\x0d\x0a"
_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_TSRESOL = 9  # option of an interface: the unit of its times
# Bytes before the IP header by link type: loopback, Ethernet, raw IP, Linux cooked 1 and 2.
_LINK_BYTES = {0: 4, 108: 4, 1: 14, 12: 0, 14: 0, 101: 0, 113: 16, 276: 20}
_ETHERNET, _VLAN = 1, (0x8100, 0x88A8)
_UDP, _IP_BYTES, _UDP_BYTES = 17, 20, 8
_CUT = (EOFError, struct.error)


@dataclass(frozen=True)
class Datagrams:
    """UDP datagrams of a capture in the order of their first fragments; their bytes stay on disk.

    data : the file, uint8; stamps_ns : (N,) time of capture; sizes : (N,) bytes of payload
    sources : (N,) IPv4 address and port of the sender as one number
    first, count : (N,) first row and number of rows of its pieces in `begin` and `length` (M,)
    loss : a sentence about missing data, empty if nothing is missing
    """

    data: NDArray[np.uint8]
    stamps_ns: Longs
    sizes: Longs
    sources: Longs
    first: Longs
    count: Longs
    begin: Longs
    length: Longs
    loss: str = ""

    def __len__(self) -> int:
        return len(self.sizes)

    def bytes_at(self, which: Longs, positions: tuple[int, ...]) -> NDArray[np.uint8]:
        """(K, P) bytes at `positions` of the payloads `which`, which must be long enough."""
        at = np.repeat(np.array([positions], np.int64), len(which), axis=0)
        piece = np.repeat(self.first[which][:, None], len(positions), axis=1)
        while (beyond := at >= self.length[piece]).any():
            at -= np.where(beyond, self.length[piece], 0)
            piece += beyond
        return np.asarray(self.data[self.begin[piece] + at])

    def payloads(self, which: Longs) -> NDArray[np.uint8]:
        """(K, size) payloads `which`, which must be of one size."""
        size = int(self.sizes[which[0]]) if len(which) else 0
        out = np.empty((len(which), size), np.uint8)
        for row, k in zip(out, which.tolist(), strict=True):
            at = 0
            for piece in range(int(self.first[k]), int(self.first[k] + self.count[k])):
                begin, length = int(self.begin[piece]), int(self.length[piece])
                row[at : at + length] = self.data[begin : begin + length]
                at += length
        return out


def read_datagrams(path: Path) -> Datagrams:
    """UDP datagrams of a pcap(ng). Raises InputError if unreadable, empty or no capture, UsageError in object storage."""
    if isinstance(path, RemotePath):
        raise UsageError(f"{path}: captures are read from a disk: copy it there")
    with input_errors(path, ValueError):
        if path.stat().st_size < 24:
            raise InputError(f"{path} is no capture: it has {path.stat().st_size} bytes")
        data = np.memmap(path, np.uint8, "r")
    frames, loss = _frames(path, np.asarray(data).data)
    return _assemble(data, frames, loss)


def _frames(path: Path, data: memoryview) -> tuple[Longs, str]:
    """(N, 4) begin, captured bytes, stamp (ns), link type of frames, and data lost at the end; InputError for no capture."""
    magic = bytes(data[:4])
    if magic in _PCAP:
        walk = _walk_pcap(data, *_PCAP[magic])
    elif magic == _PCAPNG:
        walk = _walk_pcapng(data)
    else:
        raise InputError(f"{path} is no capture: it begins with {magic.hex(' ')}, neither as pcap nor as pcapng does")
    rows: list[tuple[int, int, int, int]] = []
    loss = ""
    try:
        rows.extend(walk)
    except _CUT:
        loss = f"{path} is cut off: its last record ends beyond the file, {len(rows)} before it are read"
    return np.array(rows, np.int64).reshape(-1, 4), loss


def _walk_pcap(data: memoryview, order: str, unit_ns: int) -> Iterator[tuple[int, int, int, int]]:
    """Frames of a pcap file as rows of `_frames`; raises one of `_CUT` where the file ends within a record."""
    link = struct.unpack_from(order + "I", data, 20)[0] & 0xFFFF
    record = struct.Struct(order + "IIII")
    at, end = 24, len(data)
    while at < end:
        seconds, fraction, length, _ = record.unpack_from(data, at)
        at += 16
        if at + length > end:
            raise EOFError
        yield at, length, seconds * 10**9 + fraction * unit_ns, link
        at += length


def _walk_pcapng(data: memoryview) -> Iterator[tuple[int, int, int, int]]:
    """Frames of a pcapng file as rows of `_frames`; other blocks are skipped. Raises one of `_CUT` at a truncated block."""
    at, end, order = 0, len(data), "<"
    interfaces: list[tuple[int, int]] = []
    while at < end:
        (kind,) = struct.unpack_from(order + "I", data, at)
        if kind == _SECTION:
            order = "<" if bytes(data[at + 8 : at + 12]) == b"\x4d\x3c\x2b\x1a" else ">"
            interfaces = []
        (size,) = struct.unpack_from(order + "I", data, at + 4)
        if size < 12 or size % 4 or at + size > end:
            raise EOFError
        if kind == _INTERFACE and size >= 20:
            (link,) = struct.unpack_from(order + "H", data, at + 8)
            interfaces.append((link, _ticks_per_second(data[at + 16 : at + size - 4], order)))
        elif kind == _PACKET and size >= 32:
            number, high, low, length = struct.unpack_from(order + "IIII", data, at + 8)
            if number < len(interfaces) and length <= size - 32:
                link, ticks = interfaces[number]
                yield at + 28, length, min((high << 32 | low) * 10**9 // ticks, 2**63 - 1), link
        at += size


def _ticks_per_second(options: memoryview, order: str) -> int:
    """Clock ticks per second by the option if_tsresol: a power of 10, or of 2 if its highest bit is set; 1e6 without it."""
    at = 0
    while at + 4 <= len(options):
        code, length = struct.unpack_from(order + "HH", options, at)
        if code == 0:
            break
        if code == _TSRESOL and length == 1 and at + 5 <= len(options):
            value = options[at + 4]
            return int(2 ** min(value & 0x7F, 63) if value & 0x80 else 10 ** min(value, 18))
        at += 4 + length + -length % 4
    return 10**6


def _assemble(data: NDArray[np.uint8], frames: Longs, loss: str) -> Datagrams:
    """UDP datagrams of the frames. Those with a missing fragment are left out and counted."""

    def word(at: Longs, size: int = 2) -> Longs:
        """Big-endian numbers at these places."""
        value = np.zeros(len(at), np.int64)
        for k in range(size):
            value = value << 8 | data[np.minimum(at + k, len(data) - 1)]
        return value

    begin, captured, link = frames[:, 0], frames[:, 1], frames[:, 3]
    known = np.isin(link, list(_LINK_BYTES))
    ip = begin + np.array([_LINK_BYTES.get(number, 0) for number in link.tolist()], np.int64)
    for _ in range(2):
        ip += 4 * ((link == _ETHERNET) & np.isin(word(ip - 2), _VLAN))
    head = word(ip, 1)
    ip_bytes, total = 4 * (head & 15), word(ip + 2)
    room = begin + captured - ip
    is_udp = known & (room >= _IP_BYTES) & (head >> 4 == 4) & (ip_bytes >= _IP_BYTES) & (word(ip + 9, 1) == _UDP)
    is_whole = is_udp & (total >= ip_bytes) & (total <= room)
    short = int((is_udp & ~is_whole).sum())
    ip, ip_bytes, total = ip[is_whole], ip_bytes[is_whole], total[is_whole]
    flags = word(ip + 6)
    address, offset, has_more = word(ip + 12, 4), 8 * (flags & 0x1FFF), (flags & 0x2000) > 0
    group = _datagram_of(address, word(ip + 4), has_more | (offset > 0))
    order = np.lexsort([offset, group])
    begin, length, stamps = (ip + ip_bytes)[order], (total - ip_bytes)[order], frames[is_whole, 2][order]
    first = np.flatnonzero(np.diff(group[order], prepend=-1))
    count = np.diff(first, append=len(begin)).astype(np.int64)
    before = np.cumsum(length) - length
    fits = offset[order] == before - np.repeat(before[first], count)
    size = np.add.reduceat(length, first)
    is_right = np.logical_and.reduceat(fits, first) & ~has_more[order][first + count - 1]
    is_right &= (length[first] >= _UDP_BYTES) & (word(begin[first] + 4) == size)
    # The UDP header opens the first piece.
    sources = address[order][first] << 16 | word(begin[first])
    begin[first] += _UDP_BYTES
    length[first] -= _UDP_BYTES
    if lost := int((~is_right).sum()) + short:
        loss = f"{loss}; " if loss else ""
        loss += f"{lost} datagrams of the capture lack a part and are left out"
    return Datagrams(
        data,
        stamps[first][is_right],
        size[is_right] - _UDP_BYTES,
        sources[is_right],
        first[is_right],
        count[is_right],
        begin,
        length,
        loss,
    )


def _datagram_of(address: Longs, number: Longs, is_piece: Bools) -> Longs:
    """(N,) for each frame, the index of the first frame of its datagram.

    Fragments of a datagram share sender and number. A number repeats only after 65,536 datagrams.
    """
    group = np.arange(len(address), dtype=np.int64)
    pieces = np.flatnonzero(is_piece)
    by_sender = pieces[np.argsort(address[pieces], kind="stable")]
    if len(by_sender):
        same = (np.diff(address[by_sender]) == 0) & (np.diff(number[by_sender]) == 0)
        starts = np.flatnonzero(np.concatenate([[True], ~same]))
        group[by_sender] = np.repeat(by_sender[starts], np.diff(starts, append=len(by_sender)))
    return group
