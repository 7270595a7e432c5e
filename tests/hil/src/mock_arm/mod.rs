//! The mock controller without sockets, on a virtual clock: the same plant, interpreter, RTDE session and judge, one
//! control step per call. A second of robot time takes milliseconds, and equal calls give bit-identical results.

use crate::controller::{ClientId, Command, InputPackage, Robot, RtdeSession, Setup, Summary, Upload, World};
use graspd_rt::rtde::{Field, FrameError, Value};
use std::collections::BTreeMap;

/// A robot in memory with its RTDE clients.
pub struct MockArm {
    world: World,
    clients: BTreeMap<ClientId, Client>,
    next_client: ClientId,
    now_ns: u64,
    step_ns: u64,
}

struct Client {
    session: RtdeSession,
    out: Vec<u8>,
}

/// A client is not connected.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum PeerError {
    /// No such client.
    #[error("client {0} is not connected")]
    NotConnected(ClientId),
    /// Framing was lost; the connection was closed.
    #[error("connection closed, RTDE framing lost: {0}")]
    Framing(FrameError),
}

impl MockArm {
    /// A robot with this configuration, judged by `limits` (rad/s, rad/s^2). The clock starts at 1 s.
    pub fn new(setup: Setup, limits: Option<(f64, f64)>) -> Self {
        let robot = Robot::new(setup);
        let step_ns = (robot.dt * 1e9) as u64;
        MockArm {
            world: World::new(robot, limits, None),
            clients: BTreeMap::new(),
            next_client: 1,
            now_ns: 1_000_000_000,
            step_ns,
        }
    }

    /// Virtual CLOCK_MONOTONIC, ns.
    pub fn now_ns(&self) -> u64 {
        self.now_ns
    }

    /// The robot.
    pub fn robot(&self) -> &Robot {
        &self.world.robot
    }

    /// The robot, for preparing a test.
    pub fn robot_mut(&mut self) -> &mut Robot {
        &mut self.world.robot
    }

    /// Uploads a script; it runs from the next step on.
    pub fn upload(&mut self, text: &str) -> Upload {
        self.world.robot.upload(text)
    }

    /// Connects an RTDE client.
    pub fn connect(&mut self) -> ClientId {
        let id = self.next_client;
        self.next_client += 1;
        self.clients.insert(id, Client { session: RtdeSession::new(id), out: Vec::new() });
        self.world.judge.forget_client();
        id
    }

    /// Disconnects a client and releases its RTDE inputs.
    pub fn disconnect(&mut self, client: ClientId) {
        self.clients.remove(&client);
        self.world.owners.release(client);
    }

    /// Sends bytes from a client to the controller, however they are split.
    ///
    /// # Errors
    /// There is no such client, or framing is lost (the client is then disconnected).
    pub fn send(&mut self, client: ClientId, bytes: &[u8]) -> Result<(), PeerError> {
        let Client { session, out } = self.clients.get_mut(&client).ok_or(PeerError::NotConnected(client))?;
        let World { robot, owners, rtde_faults, judge, .. } = &mut self.world;
        let now = self.now_ns;
        let mut note = |package: InputPackage| judge.input(now, &package.values);
        let result = session.receive(bytes, robot, owners, rtde_faults, out, &mut note);
        result.map_err(|e| {
            self.disconnect(client);
            PeerError::Framing(e)
        })
    }

    /// Bytes sent by the controller to a client since the last call.
    pub fn receive(&mut self, client: ClientId) -> Vec<u8> {
        self.clients.get_mut(&client).map(|c| std::mem::take(&mut c.out)).unwrap_or_default()
    }

    /// Writes inputs like one RTDE package, without a connection.
    pub fn write_inputs(&mut self, values: &[(Field, Value)]) {
        self.world.robot.apply_inputs(values);
        self.world.judge.input(self.now_ns, values);
    }

    /// Runs one control step.
    pub fn step(&mut self) {
        self.now_ns += self.step_ns;
        self.world.step(self.now_ns);
        for client in self.clients.values_mut() {
            // Bounds the memory of a client that does not collect its packages.
            if client.out.len() > 1 << 20 {
                client.out.clear();
            }
            client.session.sample(&self.world.robot, &mut client.out);
        }
    }

    /// Steps until `done` returns true, at most `seconds`; false if it never did.
    pub fn step_until(&mut self, seconds: f64, mut done: impl FnMut(&Robot) -> bool) -> bool {
        for _ in 0..(seconds / self.world.robot.dt) as u64 {
            self.step();
            if done(&self.world.robot) {
                return true;
            }
        }
        false
    }

    /// Executes a command of the control port. Network faults have no effect here.
    ///
    /// # Errors
    /// The reason for which the command cannot be executed.
    pub fn command(&mut self, command: Command) -> Result<serde_json::Value, String> {
        self.world.command(command, self.now_ns)
    }

    /// The judge's summary.
    pub fn summary(&self) -> Summary {
        self.world.judge.summary()
    }
}
