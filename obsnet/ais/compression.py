"""A file in, its tables out as byte streams, decompressed; compression is seen from the content."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from obsnet.errors import AISError

ZSTANDARD = b"\x28\xb5\x2f\xfd"
BUFFER = 1 << 16


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn what goes wrong in opening and unpacking a file, while its streams are read, into `AISError`."""
    try:
        yield
    except (EOFError, zlib.error, lzma.LZMAError, zipfile.BadZipFile, gzip.BadGzipFile) as error:
        raise AISError(f"{path} is damaged: {error}; get the file again") from None
    except OSError as error:
        raise AISError(f"cannot read the AIS file {path}: {error.strerror or error}") from None


def streams(path: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """Name and bytes of every table of a file: one, or all members of a zip archive."""
    with open(path, "rb") as file:
        if file.peek(4)[:4] == b"PK\x03\x04":
            with zipfile.ZipFile(file) as archive:
                for member in archive.infolist():
                    if not member.is_dir() and "__MACOSX" not in member.filename:
                        with archive.open(member) as inner:
                            yield f"{path}:{member.filename}", _buffered(inner)
        else:
            yield str(path), _buffered(_decompressed(file, path))


def _buffered(raw: Any) -> IO[bytes]:
    return io.BufferedReader(raw, BUFFER)


def _decompressed(file: io.BufferedReader, path: Path) -> Any:
    magic = file.peek(4)[:4]
    if magic.startswith(b"\x1f\x8b"):
        return gzip.GzipFile(fileobj=file)
    if magic.startswith(b"BZh"):
        return bz2.BZ2File(file)
    if magic == b"\xfd7zX":
        return lzma.LZMAFile(file)
    return _Zstandard(file, path) if magic == ZSTANDARD else file


class _Zstandard(io.RawIOBase):
    """Frames of a zstandard file one after another; unlike the package's reader it notices truncation."""

    def __init__(self, file: IO[bytes], path: Path) -> None:
        try:
            import zstandard
        except ImportError:
            message = f"{path} is compressed with zstandard; to read it: pip install obsnet[ais]"
            raise AISError(message) from None
        self._file, self._error = file, zstandard.ZstdError
        self._new_frame = zstandard.ZstdDecompressor().decompressobj
        self._frame = self._new_frame()
        self._left, self._waiting = b"", b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self._waiting:
            packed = self._left or self._file.read(BUFFER)
            self._left = b""
            if not packed:
                if not self._frame.eof:
                    raise EOFError("it ends in the middle of a frame")
                return 0
            if self._frame.eof:
                self._frame = self._new_frame()
            try:
                self._waiting = self._frame.decompress(packed)
            except self._error as error:
                raise EOFError(str(error)) from None
            self._left = self._frame.unused_data if self._frame.eof else b""
        count = min(len(buffer), len(self._waiting))
        buffer[:count] = self._waiting[:count]
        self._waiting = self._waiting[count:]
        return count
