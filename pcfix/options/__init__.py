"""Every option of every command, said once; the doors and their documentation are made from it.

`pcfix.options.declare` says how; the other files are the tables: what several commands share, a
correction, what follows it, what goes before it, and made-up scenes.
"""
