import struct
import warnings
import wave

import numpy as np
import pytest
from scipy.io import wavfile

from obsnet.arrays.recording import Recording, read_wav
from obsnet.errors import WaveformError

RATE = 48_000
SIGNAL = np.random.default_rng(0).uniform(-0.9, 0.9, (4, 600))


def stored(dtype):
    if dtype == np.uint8:
        return np.round(SIGNAL * 128.0 + 128.0).astype(dtype)
    if np.issubdtype(dtype, np.integer):
        return np.round(SIGNAL * 2.0 ** (8 * np.dtype(dtype).itemsize - 1)).astype(dtype)
    return SIGNAL.astype(dtype)


@pytest.mark.parametrize(
    ("dtype", "step"),
    [(np.uint8, 2**-7), (np.int16, 2**-15), (np.int32, 1e-7), (np.float32, 1e-7), (np.float64, 1e-7)],
)
def test_every_format_reads_back_with_full_scale_one(tmp_path, dtype, step):
    path = tmp_path / "array.wav"
    wavfile.write(path, RATE, stored(dtype).T)
    rate, samples = read_wav(path)
    assert (rate, samples.shape, samples.dtype) == (RATE, (4, 600), np.float32)
    np.testing.assert_allclose(samples, SIGNAL, atol=step)


def write_24_bit(path):
    values = np.ascontiguousarray(np.round(SIGNAL.T * 2**23).astype("<i4"))
    with wave.open(str(path), "wb") as file:
        file.setnchannels(4)
        file.setsampwidth(3)
        file.setframerate(RATE)
        file.writeframes(values.view(np.uint8).reshape(-1, 4)[:, :3].tobytes())


def test_24_bit_reads_back(tmp_path):
    path = tmp_path / "array.wav"
    write_24_bit(path)
    rate, samples = read_wav(path)
    np.testing.assert_allclose(samples, SIGNAL, atol=2e-7)
    assert rate == RATE


def test_24_bit_cut_short_is_refused(tmp_path):
    path = tmp_path / "array.wav"
    write_24_bit(path)
    path.write_bytes(path.read_bytes()[: 44 + 12 * 100])
    with pytest.raises(WaveformError, match="header says 7244 bytes, it holds 1244"):
        read_wav(path)


def test_one_channel_is_one_hydrophone_and_foreign_chunks_are_passed_over(tmp_path):
    path = tmp_path / "one.wav"
    wavfile.write(path, RATE, stored(np.int16)[0])
    content = bytearray(path.read_bytes())
    note = b"bext" + struct.pack("<I", 10) + b"0123456789"
    content[36:36] = note
    content[4:8] = struct.pack("<I", len(content) - 8)
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, samples = read_wav(path)
    assert samples.shape == (1, 600)
    np.testing.assert_allclose(samples[0], SIGNAL[0], atol=2**-15)


def test_segments_beyond_the_ends_are_silent_and_gaps_are_nan(tmp_path):
    samples = SIGNAL.copy()
    samples[2, 5] = np.inf
    recording = Recording.of((RATE, samples))
    segment = recording.segment(-3, 8)
    assert segment.shape == (4, 11) and (segment[:, :3] == 0.0).all()
    assert np.isnan(segment[2, 8]) and np.isfinite(np.delete(segment, 8, axis=1)).all()
    assert (recording.segment(598, 605)[:, 2:] == 0.0).all()
    assert (recording.segment(700, 705) == 0.0).all()
    np.testing.assert_array_equal(recording.segment(10, 20)[0], SIGNAL[0, 10:20])


def test_channels_are_counted_from_one():
    recording = Recording.of((RATE, SIGNAL)).select((3, 1))
    np.testing.assert_array_equal(recording.segment(0, 600), SIGNAL[[2, 0]])
    for wrong in ((0, 1), (1, 5), ()):
        with pytest.raises(WaveformError, match="has channels 1 to 4, asked for"):
            Recording.of((RATE, SIGNAL)).select(wrong)


def broken_files(folder):
    good = folder / "good.wav"
    wavfile.write(good, RATE, stored(np.int16).T)
    content = good.read_bytes()
    compressed = bytearray(content)
    compressed[20:22] = struct.pack("<H", 6)
    headless = bytearray(content)
    headless[22:24] = struct.pack("<H", 0)
    return {
        "empty": b"",
        "text": b"time,pressure\n0,1\n" * 20,
        "header only": content[:20],
        "cut short": content[:2000],
        "cut within a frame": content[: 44 + 13],
        "compressed": bytes(compressed),
        "no channel": bytes(headless),
        "no data": content[:36],
        "no sample": content[:40] + struct.pack("<I", 0),
    }


BROKEN = (
    "empty",
    "text",
    "header only",
    "cut short",
    "cut within a frame",
    "compressed",
    "no channel",
    "no data",
    "no sample",
)


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_file_is_one_line(tmp_path, kind):
    path = tmp_path / "broken.wav"
    path.write_bytes(broken_files(tmp_path)[kind])
    with pytest.raises(WaveformError) as error:
        read_wav(path)
    assert "broken.wav" in str(error.value) and "\n" not in str(error.value)


def test_what_is_no_recording_is_named(tmp_path):
    with pytest.raises(WaveformError, match=r"absent\.wav does not exist"):
        read_wav(tmp_path / "absent.wav")
    with pytest.raises(WaveformError, match="cannot read"):
        read_wav(tmp_path)
    with pytest.raises(WaveformError, match="transpose"):
        Recording.of((RATE, SIGNAL.T))
    with pytest.raises(WaveformError, match="real, dims"):
        Recording.of((RATE, SIGNAL[0]))
    with pytest.raises(WaveformError, match="a WAV file or a pair"):
        Recording.of(5)
    with pytest.raises(WaveformError, match="sampling rate"):
        Recording.of((0.0, SIGNAL))
    with pytest.raises(WaveformError, match="holds no sample"):
        Recording.of((RATE, np.zeros((4, 0))))
