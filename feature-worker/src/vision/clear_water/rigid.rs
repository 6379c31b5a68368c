//! Rigid maps of the plane: a turn and a shift. Pure functions, called on the extraction thread; nothing allocates and nothing fails.

/// A turn about the origin followed by a shift.
#[derive(Debug, Clone, Copy)]
pub(super) struct RigidMap {
    /// Cosine of the turn.
    pub(super) cos: f32,
    /// Sine of the turn.
    pub(super) sin: f32,
    /// The shift after the turn, px.
    pub(super) shift: [f32; 2],
}

impl RigidMap {
    /// A shift alone.
    pub(super) fn shift(shift: [f32; 2]) -> Self {
        Self { cos: 1.0, sin: 0.0, shift }
    }

    /// Turns by `angle_rad` about `centre`, then shifts.
    pub(super) fn about(centre: [f32; 2], angle_rad: f32, shift: [f32; 2]) -> Self {
        let (sin, cos) = angle_rad.sin_cos();
        let [x, y] = centre;
        Self { cos, sin, shift: [x - cos * x + sin * y + shift[0], y - sin * x - cos * y + shift[1]] }
    }

    /// Where a direction comes to point.
    #[inline(always)]
    pub(super) fn turned(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        [self.cos * x - self.sin * y, self.sin * x + self.cos * y]
    }

    /// Where a place comes to lie.
    #[inline(always)]
    pub(super) fn apply(&self, at: [f32; 2]) -> [f32; 2] {
        let [x, y] = self.turned(at);
        [x + self.shift[0], y + self.shift[1]]
    }

    /// Where a place came from.
    #[inline(always)]
    pub(super) fn apply_back(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let (x, y) = (x - self.shift[0], y - self.shift[1]);
        [self.cos * x + self.sin * y, -self.sin * x + self.cos * y]
    }

    /// The map back.
    pub(super) fn inverse(&self) -> Self {
        let [x, y] = self.apply_back([0.0, 0.0]);
        Self { cos: self.cos, sin: -self.sin, shift: [x, y] }
    }

    /// This map after `first`.
    pub(super) fn after(&self, first: &RigidMap) -> Self {
        let (cos, sin) = (self.cos * first.cos - self.sin * first.sin, self.sin * first.cos + self.cos * first.sin);
        // Rounding must not make it anything but a turn, over many frames.
        let length = cos.hypot(sin);
        Self { cos: cos / length, sin: sin / length, shift: self.apply(first.shift) }
    }
}
