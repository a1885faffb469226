"""Where each number of a lens stands in the flat array that the kernels take.

The arrays of several lenses, padded with zeros, are the rows of one table. See
`pcfix.lens.imaging.coefficients`, which fills it, and `pcfix.model.Lens` for the names.
"""

KIND, LARGEST_ANGLE, LARGEST_RADIUS = range(3)
"""The projection as a number, and how far it goes: radians, and in its plane."""

TANGENTIAL, THIN_PRISM = 3, 7
IN_TURN, INVERSE, CENTRE_X, CENTRE_Y, DISC = range(11, 16)
"""`DISC` is the radius about the centre of distortion up to which Brown's formula is used."""

FOCAL_X, B2, B3, FOCAL_Y, PRINCIPAL_X, PRINCIPAL_Y, WIDTH, HEIGHT = range(16, 24)

PLAIN = 24
"""Whether the lens is perspective with Brown's k1 to k4, p1 and p2 alone, the common one."""

RADIALS, DENOMINATORS, SHAPES, SHAPE, TAIL = range(25, 30)
"""How many there are of each; k1 is at `TAIL`, the others follow, the first shape at `SHAPE`."""

LEAST_RADIALS, LEAST_SHAPES = 4, 2
"""Zeros are added up to these, so that the first few can be read without asking."""
