"""From points to a raster of heights: arrays in, arrays out.

Inside this room a plan position is given in cells from the top left corner of the raster: columns
to the right, rows downwards, so that the centre of the first cell is (0.5, 0.5).
"""
