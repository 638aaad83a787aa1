"""Projects: a frozen document with its edits and history, and the folder in which they are saved."""
