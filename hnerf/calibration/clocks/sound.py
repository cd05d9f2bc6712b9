"""Start offsets from sound: what two microphones heard, correlated."""

import logging
import shutil
import subprocess
import wave
from pathlib import Path

import numpy as np
from scipy.fft import irfft, rfft
from scipy.signal import resample

from hnerf.capture.safe_io import check_camera_name, file_named
from hnerf.errors import InputError, printable, raise_if_unreachable

RATE_HZ = 16_000  # to which sound is resampled: it travels 2 cm per sample
BAND_HZ = (200.0, 7_000.0)  # below is hum and wind
MIN_PEAK = 8.0  # minimum height of the peak, in standard deviations of the correlation
RIVAL_S = 0.05  # other peaks within this are echoes of the same offset
MIN_OVER_RIVAL = 1.3  # times the next peak
MAX_SECONDS = 7_200.0
WITHOUT_SOUND = b"does not contain any stream"  # what ffmpeg says of the output then

log = logging.getLogger("hnerf.calibration")


def sound_offset(a: np.ndarray, b: np.ndarray) -> float | None:
    """Return how many seconds later a sound is heard in the second of two sound tracks (n,), (m,) at RATE_HZ than in
    the first; None if no peak stands out, one is silent, or one is shorter than the echoes of a sound.

    Generalised cross-correlation with the phase transform (Knapp and Carter 1976): every frequency counts alike, so
    that the direct sound makes a sharp peak and echoes, which differ between microphones, make lower ones. Sound needs
    3 ms a metre, so that microphones at different distances hear it at different times. Hours of sound take gigabytes,
    so all arrays are in single precision.
    """
    if min(len(a), len(b)) < 2 * RIVAL_S * RATE_HZ or not np.ptp(a) or not np.ptp(b):
        return None
    size = 1 << (len(a) + len(b) - 1).bit_length()
    spectra = [rfft(np.asarray(track - track.mean(), np.float32), size) for track in (a, b)]
    cross = np.conj(spectra[0])
    cross *= spectra.pop()
    low, high = (round(hz * size / RATE_HZ) for hz in BAND_HZ)
    cross[:low], cross[high + 1 :] = 0, 0
    magnitude = np.abs(cross)
    cross /= magnitude + (1e-3 * magnitude[low : high + 1].mean() + 1e-30)
    correlation = irfft(cross, size)
    best = int(correlation.argmax())
    away = np.ones(size, bool)
    away[(best + np.arange(-round(RIVAL_S * RATE_HZ), round(RIVAL_S * RATE_HZ) + 1)) % size] = False
    peak = float(correlation[best])
    if peak < MIN_PEAK * float(correlation.std()) or peak < MIN_OVER_RIVAL * float(correlation[away].max()):
        return None
    return (best if best < len(b) else best - size) / RATE_HZ


def read_sound(path: Path) -> np.ndarray | None:
    """Return the sound (n,) at RATE_HZ of a video, from the .wav of the same name next to it, else, if the program
    ffmpeg is installed, from the video itself; None if there is none. Raises InputError on a .wav that cannot be read,
    or is a link."""
    beside = file_named(path.parent, check_camera_name(path.stem, path), suffixes=(".wav",))
    if beside.is_file():
        return _read_wave(beside)
    program = shutil.which("ffmpeg")
    if program is None or not path.is_file():
        return None
    command = [program, "-v", "error", "-nostdin", "-i", str(path.absolute()), "-vn", "-ac", "1", "-ar", str(RATE_HZ),
               "-t", str(MAX_SECONDS), "-f", "s16le", "-"]  # fmt: skip
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode == 0:
        return np.frombuffer(done.stdout, "<i2").astype(np.float32) if done.stdout else None
    if WITHOUT_SOUND not in done.stderr:
        *_, why = [f"exit code {done.returncode}", *done.stderr.decode(errors="replace").splitlines()]
        log.warning("%s: its sound is not used (ffmpeg: %s)", path, printable(why))
    return None


def _read_wave(path: Path) -> np.ndarray:
    """Return the mean of the channels of a .wav of 16-bit samples, resampled to RATE_HZ. Raises InputError if it is no
    such file."""
    try:
        with wave.open(str(path)) as file:
            channels, width, rate_hz = file.getnchannels(), file.getsampwidth(), file.getframerate()
            samples = file.readframes(min(file.getnframes(), int(MAX_SECONDS * rate_hz)))
    except (EOFError, OSError, RuntimeError, wave.Error) as error:  # RuntimeError: a part longer than the file
        raise_if_unreachable(error)
        raise InputError(f"{path}: not a readable .wav; export it again as 16-bit PCM") from None
    if width != 2 or rate_hz < 2 * BAND_HZ[0]:
        raise InputError(f"{path}: {8 * width} bits at {rate_hz} Hz; export it again as 16-bit PCM at 16 kHz or more")
    if len(samples) < 2 * channels:
        raise InputError(f"{path}: holds no sound; export it again, or remove it")
    whole = np.frombuffer(samples[: len(samples) - len(samples) % (2 * channels)], "<i2").reshape(-1, channels)
    sound = whole.mean(1, dtype=np.float32)
    if rate_hz == RATE_HZ:
        return np.asarray(sound)
    return np.asarray(resample(sound, max(1, round(len(sound) * RATE_HZ / rate_hz))))
