"""Images through a wavy sea, forwards: each camera ray meets the surface, bends, meets the bed.

Its own mathematics: the surface is met by
repeated substitution, the ray bent by the sines of its angles about
the surface's normal. Nothing of it is shared with what is tested.
"""

import numpy as np

GRAVITY = 9.81


class Sea:
    """Waves of lengths and directions about the wind's, slopes of a given rms, deep or shallow."""

    def __init__(self, slope_deg, lengths_m=(1.0, 6.0), depth_m=2.0, level_m=0.0, seed=3, count=16):
        rng = np.random.default_rng(seed)
        length = np.exp(rng.uniform(*np.log(lengths_m), count))
        heading = rng.normal(0.6, 0.6, count)
        k = 2.0 * np.pi / length
        self.number = k[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
        self.frequency = np.sqrt(GRAVITY * k * np.tanh(k * depth_m))
        self.phase = rng.uniform(0.0, 2.0 * np.pi, count)
        amplitude = k**-1.5 * np.sqrt(rng.chisquare(2, count))
        rms = np.sqrt((0.5 * (amplitude * k) ** 2).sum() / 2.0)  # of the slope along an axis
        self.amplitude = amplitude * np.tan(np.radians(slope_deg)) / rms
        self.level_m = level_m

    def at(self, xy, time_s):
        """Return height, shape (n,), and slopes, shape (n, 2)."""
        angle = xy @ self.number.T - self.frequency * time_s + self.phase
        height = self.level_m + np.cos(angle) @ self.amplitude
        return height, -np.sin(angle) @ (self.amplitude[:, None] * self.number)


def bed_seen(rays, start, sea, time_s, plane, n=1.34):
    """Return where rays that go down through the sea meet the bed z = a + b x + c y."""
    height = np.full(len(rays), sea.level_m)
    for _ in range(6):  # each leaves slope times tan(incidence) of the error
        place = start + ((height - start[2]) / rays[:, 2])[:, None] * rays
        height = sea.at(place[:, :2], time_s)[0]
    slope = sea.at(place[:, :2], time_s)[1]
    normal = np.column_stack([-slope, np.ones(len(rays))])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return _onto(_bent(rays, normal, n), place, plane)


def _bent(rays, normal, n):
    cosine = -(rays * normal).sum(axis=1)
    aside = rays + cosine[:, None] * normal  # of length sin(incidence)
    sine = np.linalg.norm(aside, axis=1) / n
    unit = aside / np.maximum(n * sine, 1e-300)[:, None]
    return sine[:, None] * unit - np.sqrt(1.0 - sine**2)[:, None] * normal


def _onto(rays, place, plane):
    a, b, c = plane
    rise = rays[:, 2] - b * rays[:, 0] - c * rays[:, 1]
    far = (a + b * place[:, 0] + c * place[:, 1] - place[:, 2]) / rise
    return place + far[:, None] * rays


def rays_of(photo):
    """Return the unit directions of the pixels of a pinhole camera, world frame."""
    lens = photo.lens
    u, v = np.meshgrid(np.arange(int(lens.width)) + 0.5, np.arange(int(lens.height)) + 0.5)
    x, y = (u.ravel() - lens.principal_x) / lens.focal, (v.ravel() - lens.principal_y) / lens.focal
    rays = np.column_stack([x, y, np.ones(u.size)]) @ photo.rotation
    return rays / np.linalg.norm(rays, axis=1)[:, None]


def frame(photo, sea, time_s, plane, texture):
    """Return the image of a photo, shape (rows, columns), uint8, and the places of the bed seen."""
    place = bed_seen(rays_of(photo), photo.centre, sea, time_s, plane)
    grey = np.rint(255.0 * texture(place[:, :2])).astype(np.uint8)
    shape = (int(photo.lens.height), int(photo.lens.width))
    return grey.reshape(shape), place.reshape(*shape, 3)
