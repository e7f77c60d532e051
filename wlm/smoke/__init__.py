"""Smoke as six-way lightmaps predicted from a guiding map (neural-six-way-lightmaps)."""
