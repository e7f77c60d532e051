"""The virtual texture: pages of lightmaps are decoded on a device when a view needs them and their light changes."""
