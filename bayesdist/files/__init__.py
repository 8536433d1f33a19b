"""File access: all reading, decoding, validation and writing of files.

Only regular files of a plausible size are read, and their decoded content is limited in relation to
that size. Any exception that a library raises for a damaged file becomes an `InputError`. Files are
written atomically. Code above this layer gets arrays, tables, HDUs and trees, can assume that its
input is valid, and opens no files itself.
"""
