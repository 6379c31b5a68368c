//! The rendered camera.
