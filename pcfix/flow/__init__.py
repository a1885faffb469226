"""The one calculation: over arrays, and over a whole file chunk by chunk.

Every door (command line, PDAL, Python) ends here.
"""

from pcfix.flow.files import correct_file
from pcfix.flow.points import correct_points
from pcfix.flow.restore import restore_file

__all__ = ["correct_file", "correct_points", "restore_file"]
