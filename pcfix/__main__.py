"""``python -m pcfix``."""

from pcfix.cli import main

main()
