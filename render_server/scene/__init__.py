"""The scene on the CPU: meshes, materials, animation, and the real scene from depth or a model. No OpenGL."""
