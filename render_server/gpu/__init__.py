"""OpenGL through moderngl: context, kernels, uniform blocks, per-pass timers, asynchronous readback."""
