"""The method "shared": each tile is a sum of few components, which the states (such as hours) of a lightmap share."""
