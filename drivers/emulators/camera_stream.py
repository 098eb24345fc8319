"""A live stream of uncompressed grey pictures with time stamps, as FFmpeg reads it: Matroska.

source  RFC 8794 (EBML), RFC 9559 (Matroska): a segment of unknown size, one cluster per picture;
        `V_UNCOMPRESSED` with the colour space Y800 is one byte of grey per pixel
"""

from __future__ import annotations

import struct

_UNKNOWN_SIZE = b"\x01" + b"\xff" * 7
_SEGMENT = b"\x18\x53\x80\x67"
_TICK_NS = 1000


def stream_header(width_px: int, height_px: int, frame_rate_hz: float) -> bytes:
    """Bytes at the beginning of a stream."""
    ebml = _element(
        b"\x1a\x45\xdf\xa3",
        _element(b"\x42\x86", _number(1))  # EBMLVersion
        + _element(b"\x42\xf7", _number(1))  # EBMLReadVersion
        + _element(b"\x42\xf2", _number(4))  # EBMLMaxIDLength
        + _element(b"\x42\xf3", _number(8))  # EBMLMaxSizeLength
        + _element(b"\x42\x82", b"matroska")  # DocType
        + _element(b"\x42\x87", _number(4))  # DocTypeVersion
        + _element(b"\x42\x85", _number(2)),  # DocTypeReadVersion
    )
    info = _element(
        b"\x15\x49\xa9\x66",
        _element(b"\x2a\xd7\xb1", _number(_TICK_NS))  # TimestampScale
        + _element(b"\x4d\x80", b"emulated camera")  # MuxingApp
        + _element(b"\x57\x41", b"emulated camera"),  # WritingApp
    )
    video = _element(
        b"\xe0",
        _element(b"\xb0", _number(width_px))
        + _element(b"\xba", _number(height_px))
        + _element(b"\x2e\xb5\x24", b"Y800"),  # UncompressedFourCC
    )
    track = _element(
        b"\xae",
        _element(b"\xd7", _number(1))  # TrackNumber
        + _element(b"\x73\xc5", _number(1))  # TrackUID
        + _element(b"\x83", _number(1))  # TrackType: video
        + _element(b"\x9c", _number(0))  # FlagLacing
        + _element(b"\x86", b"V_UNCOMPRESSED")  # CodecID
        + _element(b"\x23\xe3\x83", _number(round(1e9 / frame_rate_hz)))  # DefaultDuration, ns
        + video,
    )
    tracks = _element(b"\x16\x54\xae\x6b", track)
    return ebml + _SEGMENT + _UNKNOWN_SIZE + info + tracks


def picture_header(stamp_s: float, size_bytes: int) -> bytes:
    """Header of a picture's bytes.  stamp_s ≥ 0, with a resolution of a microsecond."""
    timestamp = _element(b"\xe7", _number(round(stamp_s * 1e9 / _TICK_NS)))
    block = b"\x81" + struct.pack(">h", 0) + b"\x80"  # track 1, at the cluster's time, key frame
    simple = b"\xa3" + _size(len(block) + size_bytes) + block
    cluster = b"\x1f\x43\xb6\x75" + _size(len(timestamp) + len(simple) + size_bytes)
    return cluster + timestamp + simple


def _element(identity: bytes, content: bytes) -> bytes:
    return identity + _size(len(content)) + content


def _size(count: int) -> bytes:
    return (1 << 56 | count).to_bytes(8, "big")


def _number(value: int) -> bytes:
    return value.to_bytes(max(1, (value.bit_length() + 7) // 8), "big")
