"""Files that gelflow reads and writes: images, flow fields (EXR, Middlebury .flo) and videos.

Readers raise `gelflow.errors.InputError` that names the file. Writers replace a file as a whole or not at all.
"""
