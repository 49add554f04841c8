//! What people and jobs do with points and devices beside the loops: forces, single requests.
//!
//! Never: on a cycle's thread.

use bumpless_core::{BusId, LoopId, PointId};

use super::{Bus, IoServer, PointIndex, Put, WriteStamp};
use tokio::sync::watch;

use crate::{
    Error,
    errand::{self, Asked, Errand},
    force::Force,
    job::JobConfig,
    limits::FORCE_NS_MAX,
    master::MasterView,
    modbus::{Framing, PlannedPoint, Way, driver::ModbusDriver},
};

impl IoServer {
    /// Holds a point at a value until `until_ns`: an input reads it, with the quality "forced"; an output's actuator gets it,
    /// now and with every commit, whatever is committed. Again for the same point: the new value and time count.
    ///
    /// # Errors
    /// [`Error::UnknownPoint`], [`Error::NotFinite`], [`Error::OutOfRange`], [`Error::ForceTime`],
    /// [`Error::TooManyForces`], [`Error::Closed`].
    pub fn force(&self, index: PointIndex, force: Force, now_ns: u64) -> Result<(), Error> {
        let info = self.info(index).ok_or(Error::UnknownPoint(index.0))?;
        Self::check_range(info, force.value)?;
        let lasts_ns = force.until_ns.saturating_sub(now_ns);
        if lasts_ns == 0 || lasts_ns > FORCE_NS_MAX {
            return Err(Error::ForceTime {
                point: info.id.clone(),
                seconds: lasts_ns / 1_000_000_000,
            });
        }
        let open = self.open.read();
        if !*open {
            return Err(Error::Closed);
        }
        self.forces.put(index, force)?;
        if info.writable
            && let Some((bus, point)) = self.place(index)
            && let Ok(loop_id) = LoopId::new("forced")
        {
            let stamp = WriteStamp {
                loop_id,
                term: 0,
                seq: 0,
            };
            Self::hand_over(bus, std::iter::once(Put::plain(point, force.value)), &stamp, now_ns);
        }
        Ok(())
    }

    /// Ends a force; says which there was. An output stays where it is until somebody writes it.
    pub fn unforce(&self, index: PointIndex) -> Option<Force> {
        self.forces.end(index)
    }

    /// All forces, those too whose time is over and that nobody has ended yet.
    #[must_use]
    pub fn forced(&self) -> Vec<(PointIndex, Force)> {
        self.forces.all()
    }

    /// Hands forced outputs to their devices again: one that was away may hold something else. Unchanged values that a
    /// device is known to hold are not sent. Simulated buses forget nothing.
    pub fn hold_forced(&self, now_ns: u64) {
        let open = self.open.read();
        if !*open {
            return;
        }
        for (index, force) in self.forces.all() {
            if now_ns < force.until_ns
                && self.info(index).is_some_and(|info| info.writable)
                && let Some((Bus::Modbus(modbus), point)) = self.place(index)
            {
                modbus.write(std::iter::once((point, force.value)), now_ns);
            }
        }
    }

    /// Asks a device for something beside the polls. The queue is bounded and a full one refuses; nothing is sent once
    /// `until` is over.
    ///
    /// # Errors
    /// [`Error::NoSuchBus`], [`Error::NoRegisters`], [`Error::ErrandsFull`], [`Error::Config`] for what the protocol does not
    /// know, [`Error::Closed`].
    pub fn errand(&self, bus: &BusId, errand: Errand, until: std::time::Instant) -> Result<Asked, Error> {
        errand::check(&errand)?;
        if !*self.open.read() {
            return Err(Error::Closed);
        }
        self.modbus(bus)?.errand(errand, until)
    }

    /// The named jobs of a bus, and the unit that their steps mean where they name none.
    ///
    /// # Errors
    /// [`Error::NoSuchBus`], [`Error::NoRegisters`].
    pub fn jobs(&self, bus: &BusId) -> Result<(&[JobConfig], u8), Error> {
        let plan = self.modbus(bus)?.plan();
        Ok((&plan.jobs, plan.unit_id))
    }

    /// Where the device of a bus is: `host:port`, for a connection of one's own.
    ///
    /// # Errors
    /// [`Error::NoSuchBus`], [`Error::NoRegisters`], [`Error::NoScan`] for a device that is not on plain TCP.
    pub fn address(&self, bus: &BusId) -> Result<&str, Error> {
        match &self.modbus(bus)?.plan().way {
            Way::Network {
                address,
                framing: Framing::Tcp,
                tls: None,
            } => Ok(address),
            _ => Err(Error::NoScan(bus.clone())),
        }
    }

    /// The writable points that share an address with an errand that writes; none for one that reads.
    ///
    /// # Errors
    /// [`Error::NoSuchBus`], [`Error::NoRegisters`].
    pub fn touched(&self, bus: &BusId, errand: &Errand) -> Result<Vec<PointId>, Error> {
        let plan = self.modbus(bus)?.plan();
        let Errand::Write {
            unit_id,
            table,
            start,
            words,
        } = errand
        else {
            return Ok(Vec::new());
        };
        let (start, end) = (usize::from(*start), usize::from(*start) + words.len());
        let touches = |point: &&PlannedPoint| {
            let length = if table.is_bits() {
                1
            } else {
                usize::from(point.value_type.words())
            };
            let first = usize::from(point.address);
            point.writable
                && (point.unit_id, point.table) == (*unit_id, *table)
                && first < end
                && start < first + length
        };
        Ok(plan
            .points
            .iter()
            .filter(touches)
            .map(|point| point.id.clone())
            .collect())
    }

    /// The bus of a point, if two hosts may be its device's master.
    #[must_use]
    pub fn redundant(&self, index: PointIndex) -> Option<(BusId, MasterView)> {
        let (Bus::Modbus(modbus), _) = self.place(index)? else {
            return None;
        };
        Some((modbus.plan().bus.clone(), master_view(modbus)?))
    }

    /// Does this host speak for a point? Of a device with two masters only the master does.
    #[must_use]
    pub fn speaks_for(&self, index: PointIndex) -> bool {
        match self.place(index) {
            Some((Bus::Modbus(modbus), _)) => modbus.may_write(),
            Some((Bus::Sim(_), _)) => true,
            None => false,
        }
    }

    /// A bus's other master, and whether this host is master now; none for a bus with one master.
    #[must_use]
    pub fn master(&self, bus: &BusId) -> Option<MasterView> {
        master_view(self.modbus(bus).ok()?)
    }

    /// The buses with two masters, each with the number of its mastership while this host has it.
    #[must_use]
    pub fn masterships(&self) -> Vec<(BusId, watch::Receiver<Option<u32>>)> {
        self.buses
            .iter()
            .filter_map(|bus| match bus {
                Bus::Modbus(modbus) => Some((modbus.plan().bus.clone(), modbus.epoch()?)),
                Bus::Sim(_) => None,
            })
            .collect()
    }

    fn modbus(&self, bus: &BusId) -> Result<&ModbusDriver, Error> {
        self.buses
            .iter()
            .find_map(|one| match one {
                Bus::Sim(sim) if sim.status().bus == *bus => Some(Err(Error::NoRegisters(bus.clone()))),
                Bus::Modbus(modbus) if modbus.plan().bus == *bus => Some(Ok(modbus)),
                _ => None,
            })
            .unwrap_or_else(|| Err(Error::NoSuchBus(bus.to_string())))
    }
}

fn master_view(modbus: &ModbusDriver) -> Option<MasterView> {
    let plan = modbus.plan().redundant.as_ref()?;
    let epoch = modbus.epoch().and_then(|epoch| *epoch.borrow());
    Some(MasterView {
        with: plan.with.clone(),
        epoch: epoch.filter(|_| modbus.may_write()),
        ready: modbus.reaches_the_lease(),
    })
}
