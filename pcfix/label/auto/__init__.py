"""The water surface from the cloud alone: `find_water`."""

from pcfix.label.auto.find import find_water
from pcfix.label.auto.proposal import EvidenceCurves, WaterProposal

__all__ = ["EvidenceCurves", "WaterProposal", "find_water"]
