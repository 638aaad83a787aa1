"""The work on one scan as it is kept: a frozen document, its edits, and the folder that holds it."""
