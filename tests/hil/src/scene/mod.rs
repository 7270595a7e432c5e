//! Renderer of the stereo images: a valve on a pipe, and the gripper with its marks.
//!
//! The fixed part is ray traced once per view with supersampling. The gripper is drawn into it for every frame with
//! exact area coverage, lens distortion and occlusion by depth; blur and sensor noise follow.
//!
//! [`StereoRenderer`] renders; [`crate::scenario`] defines the cell.

mod body;
mod layers;
mod raster;
mod sensor;
mod solid;
mod stage;
mod view;
mod wheel;

pub use body::Body;
pub use sensor::{Noise, Sensor};
pub use solid::{Face, Solid};
pub use stage::{Stage, Thing};
pub use view::{Moving, ViewRenderer};
pub use wheel::{Part, Wheel};

use graspd_calib::files::GripperFile;
use graspd_rt::geom::{Pose, Rig, View};

/// Renders both views of one scene.
#[derive(Debug)]
pub struct StereoRenderer {
    stage: Stage,
    body: Body,
    views: [ViewRenderer; 2],
    noise: Noise,
}

/// The part of the scene that changes between pairs.
#[derive(Clone, Copy, Debug)]
pub struct Snapshot {
    /// Gripper pose in the object frame at each camera's exposure; `None` omits the gripper.
    pub object_from_gripper: [Option<Pose>; 2],
    /// Distance between the jaws, metres.
    pub opening: f64,
    /// Image number; selects the noise.
    pub frame: u64,
    /// Marks that a fault hides, by bit.
    pub hidden_marks: u32,
}

impl StereoRenderer {
    /// Renders the fixed layers of both views on two threads; takes about a second.
    pub fn new(
        stage: &Stage,
        rig: &Rig,
        left_from_object: &Pose,
        gripper: &GripperFile,
        sensor: Sensor,
        seed: u64,
    ) -> Self {
        let make = |view: View| {
            ViewRenderer::new(stage, *rig.camera(view), rig.view_from_left(view) * left_from_object, sensor)
        };
        let views = std::thread::scope(|s| {
            let right = s.spawn(|| make(View::Right));
            let left = make(View::Left);
            // A panic of the helper thread is a bug of the renderer; rendering here again makes it visible.
            [left, right.join().unwrap_or_else(|_| make(View::Right))]
        });
        Self { stage: stage.clone(), body: Body::new(gripper), views, noise: Noise::new(seed ^ 0x5ce9e) }
    }

    /// The gripper as drawn.
    pub fn body(&self) -> &Body {
        &self.body
    }

    /// Width and height of the images.
    pub fn size(&self) -> (usize, usize) {
        let c = self.views[0].camera();
        (c.width as usize, c.height as usize)
    }

    /// Draws one view into rows of `stride` bytes.
    pub fn draw(&mut self, view: View, shot: &Snapshot, dst: &mut [u8], stride: usize) {
        let moving = shot.object_from_gripper[view.index()].map(|object_from_gripper| Moving {
            body: &self.body,
            object_from_gripper,
            opening: shot.opening,
            hidden_marks: shot.hidden_marks,
        });
        let frame = shot.frame.wrapping_mul(2).wrapping_add(view.index() as u64);
        self.views[view.index()].draw(&self.stage, moving, &self.noise, frame, dst, stride);
    }

    /// Draws one view into a new image.
    pub fn image(&mut self, view: View, shot: &Snapshot) -> image::GrayImage {
        let (w, h) = self.size();
        let mut data = vec![0; w * h];
        self.draw(view, shot, &mut data, w);
        image::GrayImage::from_raw(w as u32, h as u32, data).unwrap_or_default()
    }
}
