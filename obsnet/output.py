"""Output files that appear whole or not at all, and a folder's files together."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from obsnet.errors import OutputError

_YOUNG_S = 60.0


def prepare_folder(folder: str | Path) -> Path:
    """Make an output folder; `OutputError` if it is a file or cannot be written."""
    if not str(folder).strip():
        raise OutputError("the output folder is empty text; name a folder")
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"output {folder} is a file; give a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputError(f"cannot write into {folder}: {error.strerror}; give another folder") from None
    return folder


@contextmanager
def staged(folder: str | Path, leftovers: tuple[str, ...] = ()) -> Iterator[Path]:
    """A folder to write into, whose files take their places in `folder` together when all are written.

    After an error or an interruption `folder` is as it was before, and away if it was not there.

    Parameters
    ----------
    folder : where the files shall be.
    leftovers : names, or patterns of names, of files that an earlier run may have left in `folder` and that must not
        stay beside the new ones.

    Raises
    ------
    OutputError
        `folder` is a file, or cannot be written.
    """
    made = [path for path in (Path(folder), *Path(folder).parents) if not path.exists()]
    try:
        target = prepare_folder(folder)
        _sweep(target)
        stage = Path(tempfile.mkdtemp(prefix=".unfinished-", suffix=".tmp", dir=target))
        try:
            with locked(stage):
                yield stage
            _move(stage, target, leftovers)
        except OutputError as error:
            raise OutputError(str(error).replace(str(stage), str(target))) from None
        finally:
            shutil.rmtree(stage, ignore_errors=True)
    finally:
        for path in made:
            with suppress(OSError):  # what holds files stays
                path.rmdir()


@contextmanager
def locked(folder: Path, alone: bool = False) -> Iterator[None]:
    """Hold a lock on a folder, which a killed process lets go of too; `OSError` where it is to be held `alone` and another holds it."""
    if os.name != "posix":
        if alone:
            raise OSError("folders cannot be locked here: what a killed run left stays")
        yield
        return
    import fcntl

    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB if alone else fcntl.LOCK_SH)
        yield
    finally:
        os.close(held)


def _sweep(folder: Path) -> None:
    """Remove what a run that was killed has left: its lock went with it. What is young may not be locked yet."""
    for path in folder.glob(".unfinished-*.tmp"):
        with suppress(OSError), locked(path, alone=True):
            if time.time() - path.stat().st_mtime > _YOUNG_S:
                shutil.rmtree(path, ignore_errors=True)


def _move(stage: Path, folder: Path, leftovers: tuple[str, ...]) -> None:
    written = sorted(path.name for path in stage.iterdir())
    try:
        for name in written:
            os.replace(stage / name, folder / name)
        for path in [path for pattern in leftovers for path in folder.glob(pattern)]:
            name = path.name
            if name not in written:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {folder / name}: {error.strerror}") from None


def write_text(path: Path, text: str) -> None:
    """Write a small file aside and move it into place."""
    with aside(path) as partial:
        partial.write_text(text, encoding="utf-8")


@contextmanager
def aside(path: Path) -> Iterator[Path]:
    """Where to write a file that is moved into place once it is whole; `OutputError` where it cannot be written."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise OutputError(f"cannot write {path}: {error.strerror or error}; make room for it") from None
