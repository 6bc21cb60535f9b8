"""One GPU pass a file, its GLSL beside it with the same stem."""
