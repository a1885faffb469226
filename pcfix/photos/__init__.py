"""Photographs as if there were no water, the orthophoto of the bed, and waves from sequences."""
