"""Every option of every command, said once; the doors and their documentation are made from it.

`pcfix.options.declare` says how. The other files are the tables: groups that several commands
share, a correction, what follows it, what goes before it, photographs, and what needs no data.
"""
