"""A batch of points from what a test has at hand."""

from pcfix.refract.batch import Batch, Learned, Survey


def batch_of(
    xyz, above, water, cameras, settings, views=None, offset=None, *,
    learned=None, level_sigma_m=None, original_model=None,
):  # fmt: skip
    survey = Survey(water, cameras, settings, offset, learned or Learned())
    return Batch(xyz, above, survey, views, original_model, level_sigma_m)
