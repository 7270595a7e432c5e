//! Devices around the robot that only scripts use: encoders, Modbus signals, and the ports of the robot's Modbus
//! server.

use crate::urscript::{HostError, Value};
use std::collections::BTreeMap;

/// Modbus signals of one robot.
const MAX_SIGNALS: usize = 128;
/// Addresses of the robot's Modbus server.
const ADDRESSES: usize = 65_536;

/// A Modbus signal.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Signal {
    /// 0 digital input, 1 digital output, 2 register input, 3 register output.
    kind: usize,
    value: i32,
}

/// Encoder counters, Modbus signals and ports.
#[derive(Clone, Debug, Default)]
pub(super) struct Devices {
    /// Tick counts of the two encoders.
    encoders: [f64; 2],
    signals: BTreeMap<String, Signal>,
    port_bits: BTreeMap<usize, bool>,
    port_registers: BTreeMap<usize, i32>,
}

fn refused(text: String) -> HostError {
    HostError::Refused(text)
}

/// Argument `i` as an integer from 0 to `limit` - 1.
fn integer(name: &str, a: &[Value], i: usize, limit: usize) -> Result<usize, HostError> {
    a.get(i)
        .and_then(Value::as_f64)
        .filter(|x| x.fract() == 0.0 && *x >= 0.0 && *x < limit as f64)
        .map(|x| x as usize)
        .ok_or_else(|| refused(format!("{name}: argument {} must be an integer from 0 to {}", i + 1, limit - 1)))
}

fn number(name: &str, a: &[Value], i: usize) -> Result<f64, HostError> {
    a.get(i)
        .and_then(Value::as_f64)
        .filter(|x| x.is_finite())
        .ok_or_else(|| refused(format!("{name}: argument {} must be a finite number", i + 1)))
}

fn text<'a>(name: &str, a: &'a [Value], i: usize) -> Result<&'a str, HostError> {
    match a.get(i) {
        Some(Value::Str(s)) => Ok(s),
        _ => Err(refused(format!("{name}: argument {} must be a string", i + 1))),
    }
}

fn boolean(name: &str, a: &[Value], i: usize) -> Result<bool, HostError> {
    match a.get(i) {
        Some(Value::Bool(b)) => Ok(*b),
        _ => Err(refused(format!("{name}: argument {} must be a boolean", i + 1))),
    }
}

impl Devices {
    /// Sets the value of a Modbus signal, as the remote device would.
    pub(super) fn set_signal(&mut self, name: &str, value: i32) -> Result<(), String> {
        let signal = self.signals.get_mut(name).ok_or_else(|| format!("there is no Modbus signal '{name}'"))?;
        signal.value = value;
        Ok(())
    }

    /// Sets a register of the robot's Modbus server, as a remote client would.
    pub(super) fn set_port_register(&mut self, address: u16, value: u16) {
        self.port_registers.insert(usize::from(address), i32::from(value));
    }

    /// Evaluates a script function; `None` if it does not concern these devices.
    pub(super) fn answer(&mut self, name: &str, a: &[Value]) -> Option<Result<Value, HostError>> {
        if name.starts_with("encoder_") || name.ends_with("_conveyor_tick_count") {
            Some(self.encoder(name, a))
        } else if name.starts_with("modbus_") {
            Some(self.modbus(name, a))
        } else if name.contains("_port_") {
            Some(self.port(name, a))
        } else {
            None
        }
    }

    fn encoder(&mut self, name: &str, a: &[Value]) -> Result<Value, HostError> {
        match name {
            "get_conveyor_tick_count" => return Ok(Value::Float(self.encoders[0])),
            "set_conveyor_tick_count" => {
                self.encoders[0] = number(name, a, 0)?;
                return Ok(Value::None);
            }
            _ => {}
        }
        let encoder = &mut self.encoders[integer(name, a, 0, 2)?];
        match name {
            "encoder_get_tick_count" => return Ok(Value::Float(*encoder)),
            "encoder_unwind_delta_tick_count" => return Ok(Value::Float(number(name, a, 1)?)),
            "encoder_set_tick_count" => *encoder = number(name, a, 1)?,
            _ => {}
        }
        Ok(Value::None)
    }

    fn modbus(&mut self, name: &str, a: &[Value]) -> Result<Value, HostError> {
        if name == "modbus_add_signal" {
            let kind = integer(name, a, 3, 4)?;
            if self.signals.len() >= MAX_SIGNALS {
                return Err(refused(format!("{name}: more than {MAX_SIGNALS} signals")));
            }
            self.signals.insert(text(name, a, 4)?.to_owned(), Signal { kind, value: 0 });
            return Ok(Value::None);
        }
        let signal = text(name, a, 0)?;
        let Some(found) = self.signals.get_mut(signal) else {
            return Err(refused(format!("{name}: there is no signal '{signal}'; add it with modbus_add_signal")));
        };
        match name {
            "modbus_delete_signal" => {
                self.signals.remove(signal);
            }
            "modbus_get_signal_status" if found.kind < 2 => return Ok(Value::Bool(found.value != 0)),
            "modbus_get_signal_status" => return Ok(Value::Int(found.value)),
            "modbus_set_output_signal" if found.kind == 1 => found.value = i32::from(boolean(name, a, 1)?),
            "modbus_set_output_register" if found.kind == 3 => {
                found.value = integer(name, a, 1, ADDRESSES)? as i32;
            }
            _ => return Err(refused(format!("{name}: signal '{signal}' has another type"))),
        }
        Ok(Value::None)
    }

    fn port(&mut self, name: &str, a: &[Value]) -> Result<Value, HostError> {
        let address = integer(name, a, 0, ADDRESSES)?;
        match name {
            "read_port_bit" => return Ok(Value::Bool(self.port_bits.get(&address).copied().unwrap_or(false))),
            "read_port_register" => return Ok(Value::Int(self.port_registers.get(&address).copied().unwrap_or(0))),
            "write_port_bit" => {
                self.port_bits.insert(address, boolean(name, a, 1)?);
            }
            _ => {
                self.port_registers.insert(address, integer(name, a, 1, ADDRESSES)? as i32);
            }
        }
        Ok(Value::None)
    }
}
