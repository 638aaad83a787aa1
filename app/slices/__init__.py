"""Types of all that pages receive (docs/workbench.md).

They cost the program nothing: whoever makes slices imports them for the type check only.
"""
