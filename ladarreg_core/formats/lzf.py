"""Decompression of LZF, the byte code inside compressed PCD files.

A byte below 32 announces that many literal bytes plus one; any other one a copy from up to 8 KB back: three bits of
length, five of distance.
"""

from __future__ import annotations

from ladarreg_core.errors import FormatError

_LARGEST_GROWTH = 90  # three bytes make at most 264


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Return the `size` bytes that LZF data stand for.

    One pass in plain Python with a slice a token: 10 MB/s. Following the copies with NumPy, all at once, was measured
    to take twice as long, since tokens are short and can only be found one after the other.

    Raises:
        FormatError: if they are damaged, or stand for more or fewer.
    """
    if size > _LARGEST_GROWTH * len(data) + 32:
        raise FormatError(f"{len(data):,} compressed bytes claim to hold {size:,}; that is more than they can: damaged")
    out = bytearray()
    at = made = 0
    end = len(data)
    try:
        while at < end:
            token = data[at]
            at += 1
            if token < 32:
                after = at + token + 1
                out += data[at:after]
                at = after
                made += token + 1
                continue
            length = token >> 5
            if length == 7:
                length += data[at]
                at += 1
            length += 2
            distance = ((token & 31) << 8) + data[at] + 1
            at += 1
            begin = made - distance
            if begin < 0:
                raise FormatError("the compressed points refer to bytes before their beginning; the file is damaged")
            if distance >= length:
                out += out[begin : begin + length]
            else:  # the copy feeds itself: what lies back is repeated
                out += (out[begin:] * (length // distance + 1))[:length]
            made += length
            if made > size:
                break
    except IndexError:
        raise FormatError("the compressed points end within a token; the file is cut off") from None
    if made != size or len(out) != size:
        raise FormatError(f"the compressed points grow to {len(out):,} bytes instead of {size:,}; the file is damaged")
    return bytes(out)
