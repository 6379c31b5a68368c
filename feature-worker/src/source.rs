//! Frames from a device, a video, an image sequence or shared memory.
