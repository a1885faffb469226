"""The water surface from the cloud alone: `find_water`."""

from pcfix.water.auto.find import find_water
from pcfix.water.auto.proposal import EvidenceCurves, WaterProposal

__all__ = ["EvidenceCurves", "WaterProposal", "find_water"]
