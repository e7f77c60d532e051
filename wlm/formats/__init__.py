"""Files: EXR pictures, BC7 blocks, DDS textures and the artifact."""
