//! A serial line as a stream of bytes: opened raw, for this program alone.
//!
//! Owns: the settings of the line and its file descriptor. Never: blocks; what has to wait waits in the runtime.

use std::{
    io,
    os::fd::OwnedFd,
    pin::Pin,
    task::{Context, Poll, ready},
    time::Duration,
};

use rustix::{
    fs::{FlockOperation, Mode, OFlags},
    termios::{self, ControlModes, OptionalActions, Termios},
};
use serde::{Deserialize, Serialize};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf, unix::AsyncFd};

/// How the line is set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Line {
    /// Bits per second.
    pub(super) baud: u32,
    /// What makes the number of ones even or odd.
    pub(super) parity: Parity,
    /// 1 or 2.
    pub(super) stop_bits: u8,
}

/// The bit that tells damaged bytes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Parity {
    /// Even, the standard's choice.
    #[default]
    Even,
    /// Odd.
    Odd,
    /// None; the standard then wants two stop bits.
    None,
}

impl Line {
    /// The silence that ends a frame: 3.5 characters of 11 bits, from 19,200 baud on 1.75 ms. Source: Modbus over serial
    /// line V1.02, 2.5.1.1.
    pub(super) fn pause(self) -> Duration {
        if self.baud > 19_200 {
            return Duration::from_micros(1750);
        }
        Duration::from_micros(38_500_000 / u64::from(self.baud.max(1)))
    }
}

/// An open line.
#[derive(Debug)]
pub(super) struct Serial(AsyncFd<OwnedFd>);

impl Serial {
    /// Opens and sets it. Call it inside a runtime.
    pub(super) fn open(device: &str, line: Line) -> io::Result<Self> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let fd = rustix::fs::open(device, flags, Mode::empty())?;
        rustix::fs::flock(&fd, FlockOperation::NonBlockingLockExclusive)
            .map_err(|_| io::Error::new(io::ErrorKind::ResourceBusy, "another program uses the line"))?;
        let mut settings =
            termios::tcgetattr(&fd).map_err(|_| io::Error::new(io::ErrorKind::InvalidInput, "it is no serial line"))?;
        line.put(&mut settings)?;
        termios::tcsetattr(&fd, OptionalActions::Now, &settings)?;
        termios::tcflush(&fd, termios::QueueSelector::IOFlush)?;
        #[allow(
            deprecated,
            reason = "an OwnedFd keeps the descriptor open and its own, which is all that the unsafe function asks for"
        )]
        let watched = AsyncFd::new(fd)?;
        Ok(Self(watched))
    }
}

impl Line {
    fn put(self, settings: &mut Termios) -> io::Result<()> {
        settings.make_raw();
        settings.set_speed(self.baud)?;
        let modes = &mut settings.control_modes;
        modes.insert(ControlModes::CREAD | ControlModes::CLOCAL);
        modes.remove(ControlModes::CRTSCTS);
        modes.set(ControlModes::PARENB, self.parity != Parity::None);
        modes.set(ControlModes::PARODD, self.parity == Parity::Odd);
        modes.set(ControlModes::CSTOPB, self.stop_bits == 2);
        Ok(())
    }
}

impl AsyncRead for Serial {
    fn poll_read(self: Pin<&mut Self>, context: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        loop {
            let mut guard = ready!(self.0.poll_read_ready(context))?;
            let read = guard.try_io(|fd| Ok(rustix::io::read(fd, buffer.initialize_unfilled())?));
            if let Ok(result) = read {
                return Poll::Ready(result.map(|count| buffer.advance(count)));
            }
        }
    }
}

impl AsyncWrite for Serial {
    fn poll_write(self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        loop {
            let mut guard = ready!(self.0.poll_write_ready(context))?;
            if let Ok(result) = guard.try_io(|fd| Ok(rustix::io::write(fd, bytes)?)) {
                return Poll::Ready(result);
            }
        }
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        // The kernel sends what it has taken; waiting for its last bit would block.
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_ends_with_three_and_a_half_characters() {
        let line = |baud| Line {
            baud,
            parity: Parity::Even,
            stop_bits: 1,
        };
        assert_eq!(line(9600).pause().as_micros(), 4010);
        assert_eq!(line(19_200).pause().as_micros(), 2005);
        assert_eq!(line(115_200).pause().as_micros(), 1750);
    }
}
