"""Types of all that pages receive (docs/workbench.md).

They are imported for type checking only, so they cost nothing at run time.
"""
