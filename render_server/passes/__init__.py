"""GPU passes: one family per file, with its GLSL in shaders/."""
