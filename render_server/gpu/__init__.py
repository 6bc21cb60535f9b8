"""OpenGL through moderngl: context, programs with includes, per-pass timers, asynchronous readback."""
