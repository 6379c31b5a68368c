//! What the comparison with the remembered ground says where no line is asked about: which places are as they were, and whether a band across the
//! rays differs, however little.
//!
//! Called on the extraction thread. Nothing is allocated and nothing fails.

use opencv::core::Vec4b;
use opencv::prelude::*;

use super::super::rays::{RAYS, Rays, SAMPLES, each, size_of};
use super::{CALM, Evidence};
use crate::vision::geometry::LinearField;

/// Nearer to the lip than this a bead may hang, px.
const FAINT_FROM_PX: f32 = 8.0;
/// A faint rim shows itself on this share of the rays. Chosen by hand: half of it may be missing.
const FAINT_RAYS: f32 = 0.4;
impl Evidence {
    /// What is known of the ground in the air between the lines `from` and `to`, each given as the share of the way to it from the lip: which shares of
    /// the places are as they are remembered, and which are not. Where the ground is `even`, a place of which nothing is remembered has to be like what is
    /// remembered further out on its ray. `gain` is the picture's exposure against the memory.
    pub(in super::super) fn shares(&self, rays: &Rays, [from, to]: [LinearField; 2], even: bool, gain: f32) -> [f32; 2] {
        let (now, memory): (&[Vec4b], &[Vec4b]) =
            (self.ray_now.data_typed().unwrap_or_default(), self.ray_memory.data_typed().unwrap_or_default());
        let (mut dry, mut wet, mut looked) = (0.0f32, 0.0f32, 0.0f32);
        for ray in 0..RAYS {
            let mut further = None;
            for i in (ray * SAMPLES..(ray + 1) * SAMPLES).rev().filter(|i| rays.air[*i] > 0.0) {
                let remembered = self.remembered[i] > 0.5;
                if even && remembered {
                    further = memory.get(i).map(|p| each(|k| (f32::from(p[k]) * 255.0 * gain / f32::from(p[3].max(1))).min(255.0)));
                }
                if to.at(rays.places[i]) >= 1.0 || from.at(rays.places[i]) < 1.0 {
                    continue;
                }
                looked += 1.0;
                let away = match (remembered, further, now.get(i)) {
                    (true, ..) => self.away[i],
                    (false, Some(ground), Some(now)) => {
                        size_of(&each(|k| if k < 3 { f32::from(now[k]) - ground[k] } else { 0.0 })) / self.noise
                    }
                    _ => continue,
                };
                dry += f32::from(u8::from(away < CALM));
                wet += f32::from(u8::from(away >= CALM));
            }
        }
        [dry, wet].map(|part| part / looked.max(1.0))
    }

    /// How far the picture differs from the memory along a narrow band across the rays, in units of the noise: what the share
    /// [`FAINT_RAYS`] of the rays reaches. The rim of water lies so, however faint it is; light that changes smoothly does not count, nor what hangs at the lip.
    pub(in super::super) fn faint_band(&mut self, rays: &Rays) -> f32 {
        let near = rays.first_from(FAINT_FROM_PX);
        self.scratch.clear();
        for ray in 0..RAYS {
            let range = ray * SAMPLES..(ray + 1) * SAMPLES;
            let (away, known) = (&self.away[range.clone()], &self.remembered[range]);
            let is_known = |from: usize, to: usize| known[from..to].iter().all(|known| *known > 0.5);
            let stands_out = |r: &usize| {
                let (band, outside) = (&away[*r..r + 2], &away[r + 5..r + 10]);
                0.5 * band.iter().sum::<f32>() - 0.2 * outside.iter().sum::<f32>()
            };
            let most = (near..SAMPLES - 10).filter(|r| is_known(*r, r + 10)).map(|r| stands_out(&r)).fold(0.0, f32::max);
            self.scratch.push(most);
        }
        self.scratch.sort_unstable_by(f32::total_cmp);
        self.scratch[((1.0 - FAINT_RAYS) * (RAYS - 1) as f32) as usize]
    }
}
