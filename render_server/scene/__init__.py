"""The scene on the CPU: meshes, materials, the real scene, lights, registration. No OpenGL."""
