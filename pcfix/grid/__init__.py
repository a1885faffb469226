"""Rasters of heights, and the maps and lines that follow from them: arrays in, arrays out."""
