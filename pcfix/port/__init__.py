"""Housing ports: the light through the window of a camera under water, both ways."""
