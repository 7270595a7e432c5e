//! The servers: one thread polls all sockets and runs the control steps on a fixed time grid.
//!
//! A single thread needs no locks, and reconnecting clients start no threads. Between two steps it sleeps in `poll`, at
//! most until the deadline of the next step.

use super::command::{Command, Port, WireAction};
use super::connection::{Connection, READ_BYTES, Role, lines};
use super::rtde_session::RtdeSession;
use super::world::World;
use super::{dashboard, primary};
use crate::urscript::{Collector, Upload};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serde_json::json;
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Simultaneous connections; further ones are closed immediately.
const MAX_CONNECTIONS: usize = 128;
/// Control steps run in one go after the host stalled; beyond them the time grid is shifted.
const MAX_CATCH_UP_STEPS: u32 = 50;
/// Pause between two reads after which the line numbers of a client's text begin again, ns.
const SEND_GAP_NS: u64 = 100_000_000;
/// Longest line of the control and the interpreter port; it may hold a script.
const MAX_CONTROL_LINE_BYTES: usize = 1 << 20;
/// Longest line of the dashboard.
const MAX_DASHBOARD_LINE_BYTES: usize = 4096;
/// Connections accepted from one listener between two polls, so that the control step is not delayed.
const MAX_ACCEPTS: usize = 16;

/// Nanoseconds of CLOCK_MONOTONIC.
pub fn now_ns() -> u64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    (t.tv_sec as u64).saturating_mul(1_000_000_000).saturating_add(t.tv_nsec as u64)
}

struct Listener {
    port: Port,
    read_only: bool,
    socket: TcpListener,
}

/// The servers of one controller.
pub struct Server {
    /// The robot, the judge and the faults.
    pub world: World,
    listeners: Vec<Listener>,
    connections: Vec<Connection>,
    next_id: u64,
    period_ns: u64,
    /// Steps that began more than a step late.
    pub late_steps: u64,
}

/// A port could not be opened.
#[derive(Debug, thiserror::Error)]
#[error(
    "cannot listen on {address}: {error}; is another controller running there? Try --port-offset or another --bind address"
)]
pub struct ListenError {
    address: SocketAddr,
    error: std::io::Error,
}

/// Ports of a controller; the last field is true for the read-only ones.
const PORTS: [(u16, Port, bool); 9] = [
    (29999, Port::Dashboard, false),
    (30001, Port::Primary, false),
    (30002, Port::Secondary, false),
    (30003, Port::Realtime, false),
    (30004, Port::Rtde, false),
    (30011, Port::Primary, true),
    (30012, Port::Secondary, true),
    (30013, Port::Realtime, true),
    (30020, Port::Interpreter, false),
];

impl Server {
    /// Opens all ports at `address`, `offset` added to each, and the control port if one is given (0 picks a free
    /// port).
    pub fn bind(world: World, address: IpAddr, offset: u16, control: Option<u16>) -> Result<Self, ListenError> {
        let mut listeners = Vec::new();
        let standard = PORTS.iter().map(|(number, port, ro)| (number.saturating_add(offset), *port, *ro));
        for (number, port, read_only) in standard.chain(control.map(|c| (c, Port::Control, false))) {
            let address = SocketAddr::new(address, number);
            let socket = TcpListener::bind(address)
                .and_then(|s| s.set_nonblocking(true).map(|()| s))
                .map_err(|error| ListenError { address, error })?;
            listeners.push(Listener { port, read_only, socket });
        }
        let period_ns = (1e9 * world.robot.dt) as u64;
        Ok(Server { world, listeners, connections: Vec::new(), next_id: 1, period_ns, late_steps: 0 })
    }

    /// The number of the control port, if there is one.
    pub fn control_port(&self) -> Option<u16> {
        let control = self.listeners.iter().find(|l| l.port == Port::Control)?;
        control.socket.local_addr().ok().map(|a| a.port())
    }

    /// Serves until `stop` is set.
    pub fn run(&mut self, stop: &Arc<AtomicBool>) {
        let mut deadline = now_ns() + self.period_ns;
        let mut buffer = vec![0; READ_BYTES];
        while !stop.load(Ordering::Relaxed) {
            let now = now_ns();
            if now >= deadline {
                deadline = self.steps_due(now, deadline);
            }
            let due = self.connections.iter().filter_map(Connection::next_due).min();
            let wake = due.map_or(deadline, |d| d.min(deadline));
            self.wait(wake.saturating_sub(now_ns()), &mut buffer, now_ns);
        }
        self.world.note(now_ns(), "stopped");
    }

    /// Handles everything that clients have sent, without waiting. Together with [`Server::step`] it replaces
    /// [`Server::run`] where the caller keeps the time: real sockets on a virtual clock.
    pub fn serve(&mut self, now: u64) {
        let mut buffer = vec![0; READ_BYTES];
        self.wait(0, &mut buffer, || now);
        self.act(now);
        self.remove_ended(now);
    }

    /// Runs one control step at `now` and sends its packages.
    pub fn step(&mut self, now: u64) {
        self.world.step(now);
        self.send_step(now);
    }

    /// Runs the steps that are due and returns the next deadline. After a stall the missed steps are run in one go, and
    /// clients get the newest package only.
    fn steps_due(&mut self, now: u64, mut deadline: u64) -> u64 {
        if now - deadline > self.period_ns {
            self.late_steps += 1;
        }
        let mut made_up = 0;
        while deadline <= now {
            self.world.step(now);
            deadline += self.period_ns;
            made_up += 1;
            if made_up == MAX_CATCH_UP_STEPS && deadline <= now {
                deadline = now + self.period_ns;
            }
        }
        self.send_step(now);
        deadline
    }

    /// Sends the packages of one control step to all connections.
    fn send_step(&mut self, now: u64) {
        let every = (self.world.robot.setup.rate_hz / 10.0).max(1.0) as u64;
        let steps = self.world.robot.steps;
        let messages: Vec<u8> = {
            let waiting: Vec<_> = self.world.robot.outbox.drain().collect();
            waiting.iter().flat_map(primary::message_package).collect()
        };
        let mut state = None;
        let mut realtime = None;
        let mut sample = Vec::new();
        for c in &mut self.connections {
            let random = self.world.random();
            let wire = self.world.wire(c.port);
            match &mut c.role {
                Role::State { .. } => {
                    if !messages.is_empty() && c.port == Port::Primary {
                        c.send_newest(&messages, &wire, now, random);
                    }
                    if steps.is_multiple_of(every) {
                        let full = steps.is_multiple_of(10 * every);
                        let bytes = state.get_or_insert_with(|| primary::robot_state(&self.world.robot, full));
                        c.send_newest(bytes, &wire, now, random);
                    }
                }
                Role::Realtime { .. } => {
                    let bytes = realtime.get_or_insert_with(|| primary::realtime(&self.world.robot));
                    c.send_newest(bytes, &wire, now, random);
                }
                Role::Rtde(session) => {
                    sample.clear();
                    if session.sample(&self.world.robot, &mut sample) {
                        c.counted = c.counted.wrapping_add(1);
                        let keep = self.world.rtde_faults.keep_one_of.max(1);
                        if c.counted.is_multiple_of(keep) {
                            c.send_newest(&sample, &wire, now, random);
                        }
                    }
                }
                Role::Dashboard(_) | Role::Interpreter(_) | Role::Control(_) => {}
            }
            c.flush(&wire, now);
        }
        self.remove_ended(now);
    }

    /// Sleeps until a socket is ready, at most `for_ns`, and handles it.
    fn wait(&mut self, for_ns: u64, buffer: &mut [u8], clock: impl Fn() -> u64) {
        let now = clock();
        let mut polls = Vec::with_capacity(self.listeners.len() + self.connections.len());
        for l in &self.listeners {
            polls.push(PollFd::new(&l.socket, PollFlags::IN));
        }
        for c in &self.connections {
            let unread = now < self.world.wire(c.port).unread_until;
            let mut flags = if unread { PollFlags::empty() } else { PollFlags::IN };
            if c.wants_to_write() {
                flags |= PollFlags::OUT;
            }
            polls.push(PollFd::new(&c.stream, flags));
        }
        let timeout = Timespec { tv_sec: (for_ns / 1_000_000_000) as i64, tv_nsec: (for_ns % 1_000_000_000) as i64 };
        // A signal ends the wait early; the caller then checks its flag.
        if poll(&mut polls, Some(&timeout)).unwrap_or(0) == 0 && self.connections.iter().all(|c| c.next_due().is_none())
        {
            return;
        }
        let ready: Vec<PollFlags> = polls.iter().map(PollFd::revents).collect();
        drop(polls);
        let now = clock();
        let listeners = self.listeners.len();
        let ends = PollFlags::IN | PollFlags::HUP | PollFlags::ERR;
        for i in 0..self.connections.len() {
            let events = ready.get(listeners + i).copied().unwrap_or(PollFlags::empty());
            let Some(c) = self.connections.get_mut(i) else { continue };
            if events.intersects(ends) && now >= self.world.wire(c.port).unread_until {
                receive(c, &mut self.world, buffer, now);
            }
            let wire = self.world.wire(c.port);
            c.flush(&wire, now);
        }
        for i in 0..listeners {
            if ready.get(i).is_some_and(|e| e.contains(PollFlags::IN)) {
                self.accept(i, now);
            }
        }
        self.act(now);
        self.remove_ended(now);
    }

    fn accept(&mut self, listener: usize, now: u64) {
        let Some(l) = self.listeners.get(listener) else { return };
        for _ in 0..MAX_ACCEPTS {
            let Ok((stream, peer)) = l.socket.accept() else { break };
            let (port, read_only) = (l.port, l.read_only);
            if self.world.wire(port).refuse || self.connections.len() >= MAX_CONNECTIONS {
                continue; // dropping the stream closes it
            }
            let id = self.next_id;
            self.next_id += 1;
            let scripts = || (!read_only).then(Collector::default);
            let role = match port {
                Port::Dashboard => Role::Dashboard(Vec::new()),
                Port::Primary | Port::Secondary => Role::State { scripts: scripts() },
                Port::Realtime => Role::Realtime { scripts: scripts() },
                Port::Rtde => Role::Rtde(Box::new(RtdeSession::new(id))),
                Port::Interpreter => Role::Interpreter(Vec::new()),
                Port::Control => Role::Control(Vec::new()),
            };
            let Ok(mut c) = Connection::new(id, port, role, stream) else { continue };
            let random = self.world.random();
            let wire = self.world.wire(port);
            match port {
                Port::Dashboard => c.send(format!("{}\n", dashboard::GREETING).as_bytes(), &wire, now, random),
                Port::Primary | Port::Secondary => {
                    c.send(&primary::version_message(&self.world.robot), &wire, now, random);
                    c.send(&primary::robot_state(&self.world.robot, true), &wire, now, random);
                }
                Port::Rtde => self.world.judge.forget_client(),
                Port::Realtime | Port::Interpreter | Port::Control => {}
            }
            self.world.note(now, &format!("connection {id} {port:?} from {peer}"));
            self.connections.push(c);
        }
    }

    /// Carries out the connection actions of the control port.
    fn act(&mut self, now: u64) {
        for action in std::mem::take(&mut self.world.actions) {
            for c in &mut self.connections {
                match &action {
                    WireAction::Reset(port) if *port == c.port => c.reset(),
                    WireAction::Close(port) if *port == c.port => c.over = Some("closed on command"),
                    WireAction::Inject(port, bytes) if *port == c.port => {
                        let wire = self.world.wire(c.port);
                        c.send(bytes, &wire, now, 0.0);
                    }
                    _ => {}
                }
            }
        }
    }

    /// Removes ended connections and releases their RTDE inputs.
    fn remove_ended(&mut self, now: u64) {
        let mut i = 0;
        while let Some(c) = self.connections.get(i) {
            let Some(reason) = c.over else {
                i += 1;
                continue;
            };
            self.world.owners.release(c.id);
            let text = format!("connection {} {:?} ended: {reason}; {} packages skipped", c.id, c.port, c.skipped);
            self.world.note(now, &text);
            self.connections.swap_remove(i);
        }
    }
}

/// Prints a line to standard error; ignores a closed one.
fn log(text: &str) {
    let _ = std::io::Write::write_fmt(&mut std::io::stderr(), format_args!("graspd-mock-ur: {text}\n"));
}

/// Starts an uploaded program, or stops the running one.
fn run_upload(upload: Upload, world: &mut World, now: u64) {
    match upload {
        Upload::Program { text, first_line } => {
            if let super::programs::Upload::Refused(reason) = world.upload(now, &text, first_line) {
                log(&format!("script refused: {reason}"));
            }
        }
        Upload::StopProgram => {
            world.note(now, "stop program");
            world.robot.stop_program();
        }
    }
}

/// Reads from a connection and handles what was read.
fn receive(c: &mut Connection, world: &mut World, buffer: &mut [u8], now: u64) {
    let Some(bytes) = c.read(buffer).map(<[u8]>::to_vec) else { return };
    let wire = world.wire(c.port);
    if now < wire.deaf_until {
        return;
    }
    let mut answer = Vec::new();
    match &mut c.role {
        Role::Dashboard(rest) => match lines(rest, &bytes, MAX_DASHBOARD_LINE_BYTES) {
            Ok(found) => {
                for line in found {
                    let reply = dashboard::answer(&mut world.robot, &line);
                    world.note(now, &format!("dashboard {line}: {}", reply.line));
                    answer.extend_from_slice(reply.line.as_bytes());
                    answer.push(b'\n');
                    c.finishing |= reply.close;
                }
            }
            Err(()) => c.over = Some("sent an overlong line"),
        },
        Role::Interpreter(rest) => match lines(rest, &bytes, MAX_CONTROL_LINE_BYTES) {
            Ok(found) => {
                for line in found.iter().filter(|l| !l.trim().is_empty()) {
                    answer.extend_from_slice(world.robot.interpret(line).replace(['\n', '\r'], " ").as_bytes());
                    answer.push(b'\n');
                }
            }
            Err(()) => c.over = Some("sent an overlong line"),
        },
        Role::Control(rest) => match lines(rest, &bytes, MAX_CONTROL_LINE_BYTES) {
            Ok(found) => {
                for line in found {
                    let result = serde_json::from_str::<Command>(&line)
                        .map_err(|e| format!("{e}; commands look like {{\"cmd\": \"state\"}}"))
                        .and_then(|command| world.command(command, now));
                    let reply = match result {
                        Ok(value) => json!({"ok": true, "result": value, "at_ns": now}),
                        Err(e) => json!({"ok": false, "error": e}),
                    };
                    answer.extend_from_slice(reply.to_string().as_bytes());
                    answer.push(b'\n');
                }
            }
            Err(()) => c.over = Some("sent an overlong line"),
        },
        Role::State { scripts: Some(stream) } | Role::Realtime { scripts: Some(stream) } => {
            if now.saturating_sub(c.read_ns) > SEND_GAP_NS {
                stream.begin_send();
            }
            c.read_ns = now;
            match stream.push(&bytes) {
                Ok(uploads) => uploads.into_iter().for_each(|upload| run_upload(upload, world, now)),
                Err(reason) => c.over = Some(reason),
            }
        }
        // Read-only ports ignore input.
        Role::State { scripts: None } | Role::Realtime { scripts: None } => {}
        Role::Rtde(session) => {
            let World { robot, owners, rtde_faults, judge, recorder, .. } = world;
            let result = session.receive(&bytes, robot, owners, rtde_faults, &mut answer, &mut |package| {
                World::note_input(judge, recorder, now, &package);
            });
            if result.is_err() {
                c.over = Some("sent a package of impossible size");
            }
        }
    }
    if !answer.is_empty() {
        let random = world.random();
        c.send(&answer, &wire, now, random);
    }
}
