//! Trapezoidal speed profile along a path.

/// Position along a path with limited speed and acceleration, starting and ending at rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Profile {
    length: f64,
    speed: f64,
    accel: f64,
    time: f64,
}

impl Profile {
    /// A move over `length` (at least 0) with acceleration `accel` and speed `speed`; their absolute values are used.
    ///
    /// With a `duration` above zero the speed is chosen so that the move takes that long. If `accel` does not permit
    /// it, the move takes the shortest possible time.
    pub fn new(length: f64, speed: f64, accel: f64, duration: f64) -> Self {
        let accel = accel.abs().max(1e-6);
        let mut speed = speed.abs().max(1e-6);
        if duration > 0.0 {
            // length = v (duration - v / a): the smaller root is the trapezoidal profile.
            let root = accel * accel * duration * duration - 4.0 * accel * length;
            speed = if root > 0.0 { (accel * duration - root.sqrt()) / 2.0 } else { (accel * length).sqrt() };
        }
        // A short move has a triangular profile.
        let speed = speed.min((accel * length).sqrt()).max(1e-9);
        Profile { length, speed, accel, time: 0.0 }
    }

    /// Total time of the move, s.
    pub fn duration(&self) -> f64 {
        if self.length <= 0.0 { 0.0 } else { self.length / self.speed + self.speed / self.accel }
    }

    /// Advances by `dt` seconds and returns the position along the path.
    pub fn advance(&mut self, dt: f64) -> f64 {
        self.time = (self.time + dt).min(self.duration());
        self.position()
    }

    /// Whether the end has been reached.
    pub fn is_done(&self) -> bool {
        self.time >= self.duration()
    }

    /// Completed fraction of the length, 0 to 1.
    pub fn fraction(&self) -> f64 {
        if self.length <= 0.0 { 1.0 } else { (self.position() / self.length).clamp(0.0, 1.0) }
    }

    fn position(&self) -> f64 {
        if self.length <= 0.0 {
            return 0.0;
        }
        let (v, a) = (self.speed, self.accel);
        let ramp = v / a;
        let total = self.duration();
        let t = self.time;
        if t < ramp {
            0.5 * a * t * t
        } else if t < total - ramp {
            v * (t - 0.5 * ramp)
        } else {
            self.length - 0.5 * a * (total - t) * (total - t)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stays_inside_its_limits_and_arrives() {
        for (length, speed, accel, duration) in
            [(1.0, 0.5, 1.0, 0.0), (0.01, 1.0, 1.0, 0.0), (1.0, 9.0, 2.0, 3.0), (1.0, 9.0, 2.0, 0.1)]
        {
            let mut p = Profile::new(length, speed, accel, duration);
            let (mut last, mut last_v, dt) = (0.0, 0.0, 0.002);
            let mut steps = 0;
            while !p.is_done() {
                let s = p.advance(dt);
                let v = (s - last) / dt;
                assert!(v >= -1e-9 && v <= speed + 1e-9, "{v}");
                assert!((v - last_v).abs() <= accel * dt * 1.5 + 1e-9);
                (last, last_v) = (s, v);
                steps += 1;
                assert!(steps < 10_000);
            }
            assert!((last - length).abs() < 1e-12);
            if duration == 3.0 {
                assert!((p.duration() - 3.0).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn a_move_of_zero_length_is_done_immediately() {
        assert!(Profile::new(0.0, 1.0, 1.0, 0.0).is_done());
    }
}
