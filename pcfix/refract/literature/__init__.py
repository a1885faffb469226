"""Methods of the literature, for comparison; each a function that takes a `Bundle`."""
