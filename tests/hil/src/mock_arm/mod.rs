//! The mock controller without sockets, on a virtual clock: the same plant, interpreter, RTDE server half and oracle, a step a
//! call. A second of robot time takes milliseconds, and the same calls give the same bits.

use crate::controller::{ClientId, Command, InputPackage, Robot, RtdeSession, Setup, Summary, Upload, World};
use graspd_rt::rtde::{Field, FrameError, Value};
use std::collections::BTreeMap;

/// A robot in memory with its clients.
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

/// A connection that was never made, or is over.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum PeerError {
    /// No such client.
    #[error("client {0} is not connected")]
    NotConnected(ClientId),
    /// Framing was lost; the connection is over.
    #[error("the connection is over: {0}")]
    Framing(FrameError),
}

impl MockArm {
    /// A robot as `setup` says, held by the oracle to `limits` (rad/s, rad/s^2). The clock starts at one second.
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

    /// The robot, to set it up for a test.
    pub fn robot_mut(&mut self) -> &mut Robot {
        &mut self.world.robot
    }

    /// Runs an uploaded script from the next step on.
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

    /// Ends a client's connection; what it held is free again.
    pub fn disconnect(&mut self, client: ClientId) {
        self.clients.remove(&client);
        self.world.owners.release(client);
    }

    /// Bytes from a client to the controller, in any cut.
    ///
    /// # Errors
    /// When there is no such client, or framing is lost: then it is disconnected.
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

    /// Bytes from the controller to a client since the last call.
    pub fn receive(&mut self, client: ClientId) -> Vec<u8> {
        self.clients.get_mut(&client).map(|c| std::mem::take(&mut c.out)).unwrap_or_default()
    }

    /// Writes inputs as one package of a client would, without a connection.
    pub fn write_inputs(&mut self, values: &[(Field, Value)]) {
        self.world.robot.apply_inputs(values);
        self.world.judge.input(self.now_ns, values);
    }

    /// One control step.
    pub fn step(&mut self) {
        self.now_ns += self.step_ns;
        self.world.step(self.now_ns);
        for client in self.clients.values_mut() {
            // A client that does not collect its packages keeps the newest only.
            if client.out.len() > 1 << 20 {
                client.out.clear();
            }
            client.session.sample(&self.world.robot, &mut client.out);
        }
    }

    /// Steps until `done` says so, or `seconds` have passed; true in the first case.
    pub fn step_until(&mut self, seconds: f64, mut done: impl FnMut(&Robot) -> bool) -> bool {
        for _ in 0..(seconds / self.world.robot.dt) as u64 {
            self.step();
            if done(&self.world.robot) {
                return true;
            }
        }
        false
    }

    /// A fault or another command of the control port; faults of the wires have no effect without wires.
    ///
    /// # Errors
    /// In words, when it cannot be carried out.
    pub fn command(&mut self, command: Command) -> Result<serde_json::Value, String> {
        self.world.command(command, self.now_ns)
    }

    /// What the oracle has seen.
    pub fn summary(&self) -> Summary {
        self.world.judge.summary()
    }
}
