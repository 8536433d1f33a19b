"""Small tools of every room: types of arrays, numbers for readers, limits, files, memory."""
