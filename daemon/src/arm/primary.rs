//! Reader of the primary interface: the arm's type and its calibrated kinematics.
//!
//! Framing: `i32 size` (including this field), `u8 type`. A robot-state package (16) is a sequence of sub-packages with
//! the same framing; unknown sub-packages and unread tails are skipped.

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
/// Maximum size of a package, bytes; no controller sends larger ones.
const MAX_PACKAGE_BYTES: usize = 1 << 16;
/// Maximum distance between the flange positions of an arm's calibrated table and its model's, m. Different models are
/// farther apart.
pub const MAX_FLANGE_DISTANCE_M: f64 = 0.03;

/// The arm that the controller reports.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Identity {
    /// Robot type number: 1 UR5, 2 UR10, 3 UR3, 4 UR16, 7 UR20, 8 UR30.
    pub robot_type: i32,
    /// Its calibrated Denavit-Hartenberg table.
    pub dh: Dh,
}

/// Iterator over the sub-packages in the body of a robot-state package. It ends at an invalid size.
#[derive(Clone, Debug)]
pub struct SubPackages<'a>(&'a [u8]);

impl<'a> SubPackages<'a> {
    /// Over the body of a package of type 16, without its header of five bytes.
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

/// Type and size, header included, of the package that starts here; `None` with too few bytes or an invalid size.
pub(super) fn header(bytes: &[u8]) -> Option<(u8, usize)> {
    let &[a, b, c, d, kind] = bytes.first_chunk::<5>()?;
    let size = usize::try_from(i32::from_be_bytes([a, b, c, d])).ok()?;
    if (5..=MAX_PACKAGE_BYTES).contains(&size) { Some((kind, size)) } else { None }
}

/// Six finite doubles from byte `at`.
fn doubles(bytes: &[u8], at: usize) -> Option<[f64; 6]> {
    let raw = bytes.get(at..)?.first_chunk::<48>()?;
    let (chunks, _) = raw.as_chunks::<8>();
    let mut out = [0.0; 6];
    for (o, b) in out.iter_mut().zip(chunks) {
        *o = f64::from_be_bytes(*b);
    }
    out.iter().all(|v| v.is_finite()).then_some(out)
}

/// Reads robot type and kinematics from a robot-state body into `known`; what the body does not contain is left as it
/// is.
pub fn parse_identity(body: &[u8], known: &mut (Option<i32>, Option<Dh>)) {
    for (kind, body) in SubPackages::new(body) {
        match kind {
            // Checksums of six joints, then theta, a, d, alpha (nominal plus calibration), then a status word.
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

/// Reads the arm's type and kinematics from the primary interface, which sends them about once a second.
///
/// # Errors
/// No connection, or no such package within the timeout.
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
                return Err(fail(std::io::Error::new(
                    std::io::ErrorKind::InvalidData,
                    "a package with an invalid size",
                )));
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

/// Refuses an arm that is not the configured model, by its type number and by the flange positions of its table.
///
/// # Errors
/// [`ArmError::WrongModel`].
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
    let distance_m = flange_distance(&Dh::nominal(model), &identity.dh);
    // Written so that NaN is refused.
    if !(distance_m < MAX_FLANGE_DISTANCE_M) {
        return Err(wrong(format!("kinematics {:.0} mm away from that model's", distance_m * 1e3)));
    }
    Ok(())
}

/// Refuses kinematics that differ from those that the controller reports.
///
/// # Errors
/// [`ArmError::OtherKinematics`].
pub fn check_kinematics(identity: &Identity, dh: &Dh) -> Result<(), ArmError> {
    let distance_m = flange_distance(&identity.dh, dh);
    if !(distance_m < MAX_FLANGE_DISTANCE_M) {
        return Err(ArmError::OtherKinematics { distance_mm: distance_m * 1e3 });
    }
    Ok(())
}

/// Maximum distance between the flange positions of two tables over three configurations, m. Single parameters of
/// calibrated tables differ by metres (parallel axes) and flange positions by millimetres, so that only the flange can
/// be compared.
pub fn flange_distance(a: &Dh, b: &Dh) -> f64 {
    let configurations = [[0.0; 6], [0.5, -1.2, 1.0, -0.7, 1.3, 0.2], [-1.0, -0.4, -1.5, 0.9, -1.1, 2.0]];
    configurations.iter().fold(0.0, |max: f64, q| {
        let flange = |dh: &Dh| dh.base_from_flange(q).translation.vector;
        let distance = (flange(a) - flange(b)).norm();
        if distance.is_nan() { f64::INFINITY } else { max.max(distance) }
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
    fn a_calibrated_table_is_read_and_matches_its_model_only() {
        let mut dh = Dh::nominal(Model::Ur5e);
        dh.a[1] += 0.002;
        // Calibrated arms have large opposite offsets here.
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
        fn arbitrary_bytes_do_not_panic(body in proptest::collection::vec(any::<u8>(), 0..600), cut in 0usize..1200) {
            let mut known = (None, None);
            parse_identity(&body, &mut known);
            let mut real = state(&Dh::nominal(Model::Ur3), 3);
            real.truncate(cut);
            parse_identity(&real, &mut known);
        }
    }

    /// A file's table against the controller's, on both sides of the limit and with NaN.
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
        let message = longer(0.031).unwrap_err().to_string();
        assert!(message.contains("31 mm") && message.contains("arm.kinematics"), "{message}");
        assert!(longer(f64::NAN).is_err());
    }
}
