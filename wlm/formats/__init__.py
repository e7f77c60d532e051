"""Readers and writers of files: pictures, textures, block codecs, meshes, volumes, probes and artifacts."""
