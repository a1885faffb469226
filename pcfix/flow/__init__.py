"""The commands: each reads, computes and writes, for arrays or a file in chunks.

Every door (command line, PDAL, Python) ends here.
"""
