"""The method "shared": each tile is a sum of a few components, which the states of a sheet share."""
