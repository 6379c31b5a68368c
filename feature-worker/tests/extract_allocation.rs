//! The extraction under an allocator that aborts the process when Rust code allocates or frees memory.
//!
//! This does not show what OpenCV allocates: its matrix headers and the buffers that it keeps are made by its C++ code.

mod drawn;

use assert_no_alloc::{AllocDisabler, assert_no_alloc};
use drawn::{camera, image_config, pour, water};
use feature_worker::vision::{Extractor, Image};
use opencv::prelude::*;
use shared::config::LiquidMethod;
use shared::messages::PixelFormat;

#[global_allocator]
static ALLOCATOR: AllocDisabler = AllocDisabler;

/// Protects the extraction thread's pace: after two frames no frame allocates, whether dry or with a stream, coloured or clear, while the
/// background turns so far that its memory is moved on.
#[test]
fn no_frame_allocates() -> drawn::Outcome {
    for method in [LiquidMethod::Colour, LiquidMethod::Clear] {
        let mut extractor = Extractor::new(&camera(), &image_config(method))?;
        let mut streams = 0;
        for i in 0..60 {
            let share = (1.0 - (i - 20) as f32 / 13.0 * if i < 20 { -1.0 } else { 1.0 }).max(0.0);
            let picture = if method == LiquidMethod::Colour { pour(i)? } else { water(share, Some(1.5 * i as f32), i)? };
            let image = Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: picture.data_bytes()? };
            let measured = if i < 2 { extractor.measure(image) } else { assert_no_alloc(|| extractor.measure(image)) };
            streams += u32::from(measured?.area_px2 > 0.0);
        }
        assert!(streams > 15, "{method:?}: a stream was seen in {streams} frames");
    }
    Ok(())
}
