"""Data precomputed for objects: occlusion fields (method `aroof`) and light transfer (shading `precomputed`)."""
