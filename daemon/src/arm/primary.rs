//! Reader of the primary interface: who the arm is, and its calibrated kinematics.
//!
//! Framing: `i32 size` (this field included), `u8 type`. A robot-state package (16) is a row of sub-packages framed alike;
//! unknown ones and unread tails are skipped.

use std::io::Read;
use std::time::{Duration, Instant};

use graspd_rt::arm::{Dh, Model};

use super::ur_config::{ArmError, Port, UrConfig};

/// Package type of a robot state.
const ROBOT_STATE: u8 = 16;
/// Sub-package with the calibrated Denavit-Hartenberg table.
const KINEMATICS: u8 = 5;
/// Sub-package with limits and the robot's type.
const CONFIGURATION: u8 = 6;
/// Larger packages than this are not sent by any controller.
const MAX_PACKAGE: usize = 1 << 16;
/// An arm as built is this close to its model's table at the flange, m. Models differ by more.
pub const SAME_ARM: f64 = 0.03;

/// What the controller says about the arm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Identity {
    /// Robot type number: 1 UR5, 2 UR10, 3 UR3, 4 UR16, 7 UR20, 8 UR30.
    pub robot_type: i32,
    /// The unit's own table.
    pub dh: Dh,
}

/// The sub-packages of a robot-state package's body. Ends where a size cannot be right.
#[derive(Clone, Debug)]
pub struct SubPackages<'a>(&'a [u8]);

impl<'a> SubPackages<'a> {
    /// Over the body of a package of type 16, behind its header of five bytes.
    pub fn new(body: &'a [u8]) -> SubPackages<'a> {
        SubPackages(body)
    }
}

impl<'a> Iterator for SubPackages<'a> {
    /// Type and body.
    type Item = (u8, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let (kind, size) = header(self.0)?;
        let body = self.0.get(5..size)?;
        self.0 = self.0.get(size..)?;
        Some((kind, body))
    }
}

/// Type and whole size of what starts here; `None` when there are too few bytes or the size is impossible.
pub(super) fn header(bytes: &[u8]) -> Option<(u8, usize)> {
    let &[a, b, c, d, kind] = bytes.first_chunk::<5>()?;
    let size = usize::try_from(i32::from_be_bytes([a, b, c, d])).ok()?;
    if (5..=MAX_PACKAGE).contains(&size) { Some((kind, size)) } else { None }
}

/// Six doubles from byte `at`.
fn doubles(bytes: &[u8], at: usize) -> Option<[f64; 6]> {
    let raw = bytes.get(at..)?.first_chunk::<48>()?;
    let (chunks, _) = raw.as_chunks::<8>();
    let mut out = [0.0; 6];
    for (o, b) in out.iter_mut().zip(chunks) {
        *o = f64::from_be_bytes(*b);
    }
    out.iter().all(|v| v.is_finite()).then_some(out)
}

/// Reads what a robot-state body says about the arm into what is known so far: type, table.
pub fn parse_identity(body: &[u8], known: &mut (Option<i32>, Option<Dh>)) {
    for (kind, body) in SubPackages::new(body) {
        match kind {
            // Checksums of six joints, then theta, a, d, alpha, then a status word. The table is nominal plus calibration.
            KINEMATICS => {
                let column = |i: usize| doubles(body, 24 + 48 * i);
                if let (Some(theta), Some(a), Some(d), Some(alpha)) = (column(0), column(1), column(2), column(3)) {
                    known.1 = Some(Dh { a, d, alpha, theta });
                }
            }
            // 24 limits, five defaults, four nominal columns, then board version, box type, robot type.
            CONFIGURATION => {
                let at = 8 * (24 + 5 + 24) + 8;
                if let Some(raw) = body.get(at..).and_then(|b| b.first_chunk::<4>()) {
                    known.0 = Some(i32::from_be_bytes(*raw));
                }
            }
            _ => {}
        }
    }
}

/// Asks the primary interface who the arm is. The two sub-packages come about once a second.
pub fn read_identity(config: &UrConfig) -> Result<Identity, ArmError> {
    let mut stream = config.open(Port::Primary)?;
    let fail = |source| ArmError::Io { service: Port::Primary, source };
    let deadline = Instant::now() + config.timeout;
    let timeout =
        ArmError::Timeout { what: "kinematics on the primary interface", seconds: config.timeout.as_secs_f64() };
    let mut known = (None, None);
    let mut bytes: Vec<u8> = Vec::new();
    let mut chunk = [0u8; 8192];
    while Instant::now() < deadline {
        stream.set_read_timeout(Some(Duration::from_millis(100))).map_err(fail)?;
        match stream.read(&mut chunk) {
            Ok(0) => return Err(fail(std::io::ErrorKind::UnexpectedEof.into())),
            Ok(n) => bytes.extend_from_slice(chunk.get(..n).unwrap_or_default()),
            Err(e) if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) => continue,
            Err(e) => return Err(fail(e)),
        }
        while bytes.len() >= 5 {
            let Some((kind, size)) = header(&bytes) else {
                return Err(fail(std::io::Error::new(std::io::ErrorKind::InvalidData, "a package of impossible size")));
            };
            if bytes.len() < size {
                break;
            }
            if kind == ROBOT_STATE {
                parse_identity(bytes.get(5..size).unwrap_or_default(), &mut known);
            }
            bytes.drain(..size);
        }
        if let (Some(robot_type), Some(dh)) = known {
            return Ok(Identity { robot_type, dh });
        }
    }
    Err(timeout)
}

/// Refuses an arm that is not the configured model: by type number, and by where its table puts the flange.
pub fn check_model(identity: &Identity, model: Model) -> Result<(), ArmError> {
    let (number, family) = match model {
        Model::Ur5 | Model::Ur5e => (1, "UR5"),
        Model::Ur10 | Model::Ur10e => (2, "UR10"),
        Model::Ur3 | Model::Ur3e => (3, "UR3"),
        Model::Ur16e => (4, "UR16"),
        Model::Ur20 => (7, "UR20"),
        Model::Ur30 => (8, "UR30"),
    };
    let wrong = |found| ArmError::WrongModel { expected: model.name(), found };
    if identity.robot_type != number {
        return Err(wrong(format!("robot type {} ({family} is {number})", identity.robot_type)));
    }
    let apart = flanges_apart(&Dh::nominal(model), &identity.dh);
    // Written so that NaN is refused.
    if !(apart < SAME_ARM) {
        return Err(wrong(format!("kinematics {:.0} mm away from that model's", apart * 1e3)));
    }
    Ok(())
}

/// Refuses kinematics that are not those of the arm at hand: what the controller says of itself is the measure.
pub fn check_kinematics(identity: &Identity, dh: &Dh) -> Result<(), ArmError> {
    let apart = flanges_apart(&identity.dh, dh);
    if !(apart < SAME_ARM) {
        return Err(ArmError::OtherKinematics { apart_mm: apart * 1e3 });
    }
    Ok(())
}

/// How far apart two tables put the flange, at worst, m. Calibrated tables differ in single numbers by metres (parallel
/// axes) and in the flange by millimetres, so that only the flange tells.
pub fn flanges_apart(a: &Dh, b: &Dh) -> f64 {
    let places = [[0.0; 6], [0.5, -1.2, 1.0, -0.7, 1.3, 0.2], [-1.0, -0.4, -1.5, 0.9, -1.1, 2.0]];
    places.iter().fold(0.0, |worst: f64, q| {
        let flange = |dh: &Dh| dh.base_from_flange(q).translation.vector;
        let apart = (flange(a) - flange(b)).norm();
        if apart.is_nan() { f64::INFINITY } else { worst.max(apart) }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn part(kind: u8, body: &[u8]) -> Vec<u8> {
        let mut out = (body.len() as i32 + 5).to_be_bytes().to_vec();
        out.push(kind);
        out.extend_from_slice(body);
        out
    }

    fn state(dh: &Dh, robot_type: i32) -> Vec<u8> {
        let mut kinematics = vec![0u8; 24];
        for column in [dh.theta, dh.a, dh.d, dh.alpha] {
            column.iter().for_each(|v| kinematics.extend(v.to_be_bytes()));
        }
        kinematics.extend([0; 4]);
        let mut configuration = vec![0u8; 8 * 53];
        for word in [5, 3, robot_type, 0] {
            configuration.extend(i32::to_be_bytes(word));
        }
        [part(99, b"unknown"), part(KINEMATICS, &kinematics), part(CONFIGURATION, &configuration)].concat()
    }

    #[test]
    fn a_units_own_table_is_read_and_its_model_known() {
        let mut dh = Dh::nominal(Model::Ur5e);
        dh.a[1] += 0.002;
        // Calibrated units have large opposite offsets here.
        dh.d[1] += 30.0;
        dh.d[2] -= 30.0;
        let mut known = (None, None);
        parse_identity(&state(&dh, 1), &mut known);
        let identity = Identity { robot_type: known.0.unwrap(), dh: known.1.unwrap() };
        assert_eq!(identity, Identity { robot_type: 1, dh });
        check_model(&identity, Model::Ur5e).unwrap();
        for other in Model::ALL.into_iter().filter(|m| *m != Model::Ur5e) {
            assert!(check_model(&identity, other).is_err(), "{other:?}");
        }
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(body in proptest::collection::vec(any::<u8>(), 0..600), cut in 0usize..1200) {
            let mut known = (None, None);
            parse_identity(&body, &mut known);
            let mut real = state(&Dh::nominal(Model::Ur3), 3);
            real.truncate(cut);
            parse_identity(&real, &mut known);
        }
    }

    /// A file's table against the controller's, on both sides of what one arm may differ by, and with a number that is
    /// none.
    #[test]
    fn kinematics_of_another_arm_are_refused() {
        let dh = Dh::nominal(Model::Ur5e);
        let identity = Identity { robot_type: 1, dh };
        let longer = |m: f64| {
            let mut other = dh;
            other.d[0] += m;
            check_kinematics(&identity, &other)
        };
        assert!(longer(0.0).is_ok() && longer(0.029).is_ok());
        let said = longer(0.031).unwrap_err().to_string();
        assert!(said.contains("31 mm") && said.contains("arm.kinematics"), "{said}");
        assert!(longer(f64::NAN).is_err());
    }
}
