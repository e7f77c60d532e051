"""A mesh's lightmap as new UVs, a UV look-up table and a small colour texture (lightmap-uv-clustering-cascade)."""
