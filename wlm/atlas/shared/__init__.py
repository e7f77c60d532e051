"""The method "shared": the lightmaps of many sheets and states share tiles as sums of components."""
