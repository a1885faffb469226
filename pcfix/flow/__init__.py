"""The one calculation: over arrays, and over a whole file chunk by chunk.

Every door (command line, PDAL, Python) ends here.
"""
