"""Plane waves at any elements, drawn without the package: recordings and spectra of snapshots for tests of trackers."""

import numpy as np

SOUND_SPEED = 1500.0


def unit(bearing):
    return np.array([np.cos(np.radians(bearing)), np.sin(np.radians(bearing))])


def spectra(rng, places, frequencies, sources, snapshots=10, diffuse=0.0, errors=None):
    """Spectra at the elements in noise of power 1 per bin, shape (snapshots, F, N).

    Sources are (direction in the plane in deg, power per bin relative to the noise, tone in Hz or None). `diffuse` is
    the power of noise from all directions; `errors` are complex gains of the elements.
    """
    f = np.asarray(frequencies)

    def noise(*shape):
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2.0)

    x = noise(snapshots, len(f), len(places))
    sources = list(sources)
    if diffuse:
        sources += [(d, diffuse / 72.0, None) for d in np.arange(0.0, 360.0, 5.0) + rng.uniform(0.0, 5.0)]
    for direction, power, tone in sources:
        wave = np.exp(2j * np.pi * f[:, None] * (places @ unit(direction)) / SOUND_SPEED)
        if tone is None:
            x += np.sqrt(power) * noise(snapshots, len(f))[..., None] * wave
        else:
            at = np.abs(f - tone).argmin()
            phase = np.exp(2j * np.pi * rng.uniform())
            x[:, at] += np.sqrt(power * len(f)) * phase * wave[at]
    return x if errors is None else x * errors


def coverage(tracks, truths, tolerance=3.0, turn=False):
    """Share of the rows in which each target is tracked, and the number of tracks at no target for most of their rows.

    Truths hold a bearing per row, NaN where the target is absent.
    """

    def away(a, b):
        return abs((a - b + 180.0) % 360.0 - 180.0) if turn else abs(a - b)

    shares, false = [], 0
    for truth in truths:
        rows = np.flatnonzero(~np.isnan(truth))
        near = [
            any(t.first <= k <= t.last and away(t.bearings[k - t.first], truth[k]) < tolerance for t in tracks)
            for k in rows
        ]
        shares.append(float(np.mean(near)))
    for track in tracks:
        near = [
            any(away(bearing, truth[track.first + i]) < tolerance for truth in truths)
            for i, bearing in enumerate(track.bearings)
        ]
        false += np.mean(near) <= 0.5
    return shares, int(false)


def recording(rng, places, rate, seconds, sources, noise=1.0):
    """Samples at the elements of white noise and broadband or tonal sources. Shape (samples, N).

    Sources are (directions in deg, one per second, standard deviation, tone in Hz or None). Delays are those of the
    direction of the second, by phases of its spectrum.
    """
    length = round(rate)
    out = noise * rng.normal(size=(length * seconds, len(places)))
    f = np.fft.rfftfreq(length, 1.0 / rate)
    for directions, level, tone in sources:
        for k in range(seconds):
            own = (
                np.sqrt(2.0) * np.sin(2.0 * np.pi * tone * (np.arange(length) / rate + k))
                if tone
                else rng.normal(size=length)
            )
            ahead = places @ unit(directions[k]) / SOUND_SPEED
            spectrum = np.fft.rfft(level * own)[:, None] * np.exp(2j * np.pi * f[:, None] * ahead)
            out[k * length : (k + 1) * length] += np.fft.irfft(spectrum, length, axis=0)
    return out
