"""The door: the one room in which files are opened, decoded and checked, or written.

What is read is a regular file of a plausible size, whose content is no larger than its size allows;
whatever libraries say of a damaged one is one `InputError`.  What is written appears whole or not
at all.  Rooms above get arrays, tables, HDUs and trees, and open no file themselves.
"""
