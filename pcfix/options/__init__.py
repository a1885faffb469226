"""All options of all commands, each declared once: flags, keywords and documents follow from it.

`declare` has the mechanism, `shared` the options of several commands, `correct` those of a
correction and of the steps before it, and `steps` those after it, of photographs, and of commands
without data.
"""
