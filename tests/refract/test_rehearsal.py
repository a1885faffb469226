"""What is compiled ahead is what a correction needs: with arguments of the same types."""

import importlib

import pcfix
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Survey
from pcfix.refract.rehearsal import rehearsals
from tests.utils.simulated import simulated


def test_nothing_else_is_compiled():
    # of depth maps, so that the bed is learned too
    scene = simulated(12_000, seed=1, lidar_per_m2=0.0, cloud="depth-maps")
    pcfix.correct_points(scene.apparent_xyz, scene.cameras, scene.water, method="auto")
    for one in rehearsals(Survey(scene.water, scene.cameras, ScienceOptions())):
        before = [kernel_of(name).signatures for name in one.kernels]
        assert all(before)
        one.run()
        assert [kernel_of(name).signatures for name in one.kernels] == before


def kernel_of(name):
    module, _, kernel = name.rpartition(".")
    return getattr(importlib.import_module(module), kernel)
