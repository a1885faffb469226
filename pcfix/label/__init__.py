"""Which points are under water, and what the surface looks like above them."""
