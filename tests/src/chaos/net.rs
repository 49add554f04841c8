//! Each host on a machine of its own, as far as the network goes: a network namespace per host, all on one bridge.
//!
//! ```text
//!  this process 10.x.y.254 ── bridge ─┬─ veth ── namespace 0: 10.x.y.1   (the home)
//!                                     ├─ veth ── namespace 1: 10.x.y.2
//!                                     └─ …
//! ```
//! A cut from one host to another is a rule of the second's firewall: what comes from the first is dropped before anybody there
//! sees it, while the way back stays open. Where there is no `nft`, the first gets a wrong link address for the second instead:
//! what it sends there leaves the machine and reaches nobody. That needs `ip` alone.
//! A shell takes everything down when this process is gone, however it went. Never: touches an interface that it did not make.

use std::{
    io::Write as _,
    net::Ipv4Addr,
    process::{Child, Command, Stdio},
};

use crate::Error;

/// Hosts of one net: beyond what a bench needs, and far below what fits in the addresses.
const HOSTS_MAX: usize = 32;

/// A link address that nobody has; locally administered.
const NOWHERE: &str = "02:00:00:00:be:ef";

/// What each host's firewall drops: whatever comes from an address of this set.
const RULES: &str = "table ip bumpless {
  set unheard { type ipv4_addr; }
  chain input { type filter hook input priority 0; policy accept; ip saddr @unheard drop; }
}
";

/// A net of namespaces.
#[derive(Debug)]
pub struct Net {
    firewall: bool,
    tag: String,
    subnet: [u8; 3],
    hosts: usize,
    cleaner: Child,
}

fn ip(arguments: &str) -> Result<(), Error> {
    let output = Command::new("ip")
        .args(arguments.split_whitespace())
        .stdin(Stdio::null())
        .output()
        .map_err(|source| Error::Program {
            program: "ip".to_owned(),
            source,
        })?;
    if output.status.success() {
        return Ok(());
    }
    Err(Error::Program {
        program: format!("ip {arguments}"),
        source: std::io::Error::other(String::from_utf8_lossy(&output.stderr).trim().to_owned()),
    })
}

/// Sets a namespace's firewall up.
fn firewall(space: &str) -> Result<(), Error> {
    let failed = |source| Error::Program {
        program: "nft".to_owned(),
        source,
    };
    let mut child = Command::new("ip")
        .args(["netns", "exec", space, "nft", "-f", "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(failed)?;
    if let Some(mut stdin) = child.stdin.take() {
        // Where the program is not there, its end says so.
        let _written = stdin.write_all(RULES.as_bytes());
    }
    let output = child.wait_with_output().map_err(failed)?;
    if output.status.success() {
        return Ok(());
    }
    let words = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    Err(failed(std::io::Error::other(words)))
}

impl Net {
    /// Makes the namespaces for so many hosts, at most 32.
    ///
    /// # Errors
    /// [`Error::Program`] where `ip` is missing or this user may not: then hosts can only share the loopback interface.
    pub fn new(hosts: usize) -> Result<Self, Error> {
        let pid = std::process::id();
        let tag = format!("bl{pid:x}");
        // Another run has another process id; 10.64.0.0/10 is seldom used at home.
        let [.., high, low] = pid.to_be_bytes();
        let subnet = [10, 64 | (high & 0x3f), low];
        let hosts = hosts.min(HOSTS_MAX);
        let mut script = format!("read -r _; ip link del {tag}b");
        for n in 0..hosts {
            script.push_str(&format!("; ip netns del {tag}-{n}"));
        }
        let cleaner = Command::new("sh")
            .args(["-c", &script])
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .map_err(|source| Error::Program {
                program: "sh".to_owned(),
                source,
            })?;
        // From here on everything is taken down with `net`, complete or not.
        let mut net = Self {
            firewall: true,
            tag,
            subnet,
            hosts,
            cleaner,
        };
        let tag = &net.tag;
        ip(&format!("link add {tag}b type bridge"))?;
        ip(&format!("addr add {}/24 dev {tag}b", net.own_address()))?;
        ip(&format!("link set {tag}b up"))?;
        for n in 0..hosts {
            let space = net.space(n);
            ip(&format!("netns add {space}"))?;
            ip(&format!("link add {tag}v{n} type veth peer name eth0 netns {space}"))?;
            ip(&format!("link set {tag}v{n} master {tag}b up"))?;
            ip(&format!("-n {space} addr add {}/24 dev eth0", net.address(n)))?;
            ip(&format!("-n {space} link set lo up"))?;
            ip(&format!("-n {space} link set eth0 up"))?;
        }
        net.firewall = (0..hosts).all(|n| firewall(&net.space(n)).is_ok());
        Ok(net)
    }

    /// By what hosts are cut off, for people.
    #[must_use]
    pub const fn means(&self) -> &'static str {
        if self.firewall {
            "nftables"
        } else {
            "wrong link addresses, for nft does not work here"
        }
    }

    fn space(&self, host: usize) -> String {
        format!("{}-{host}", self.tag)
    }

    /// How many hosts there are.
    #[must_use]
    pub const fn hosts(&self) -> usize {
        self.hosts
    }

    /// The address of a host, from 0.
    #[must_use]
    pub fn address(&self, host: usize) -> Ipv4Addr {
        let [a, b, c] = self.subnet;
        Ipv4Addr::new(a, b, c, u8::try_from(host + 1).unwrap_or(u8::MAX))
    }

    /// This process's own address in the net.
    #[must_use]
    pub fn own_address(&self) -> Ipv4Addr {
        let [a, b, c] = self.subnet;
        Ipv4Addr::new(a, b, c, 254)
    }

    /// Words before a command that shall run as that host.
    #[must_use]
    pub fn launcher(&self, host: usize) -> Vec<String> {
        let space = self.space(host);
        ["ip", "netns", "exec", &space].map(str::to_owned).to_vec()
    }

    /// From now on nothing that host `from` sends reaches host `to`.
    ///
    /// # Errors
    /// [`Error::Program`].
    pub fn cut(&self, from: usize, to: usize) -> Result<(), Error> {
        if self.firewall {
            return self.unheard("add", from, to);
        }
        let (space, to) = (self.space(from), self.address(to));
        ip(&format!(
            "-n {space} neigh replace {to} lladdr {NOWHERE} dev eth0 nud permanent"
        ))
    }

    /// It does again.
    ///
    /// # Errors
    /// [`Error::Program`].
    pub fn heal(&self, from: usize, to: usize) -> Result<(), Error> {
        if self.firewall {
            return self.unheard("delete", from, to);
        }
        let (space, to) = (self.space(from), self.address(to));
        ip(&format!("-n {space} neigh del {to} dev eth0"))
    }

    fn unheard(&self, verb: &str, from: usize, to: usize) -> Result<(), Error> {
        let (space, from) = (self.space(to), self.address(from));
        ip(&format!(
            "netns exec {space} nft {verb} element ip bumpless unheard {{ {from} }}"
        ))
    }
}

impl Drop for Net {
    fn drop(&mut self) {
        // The end of its input makes the cleaner work.
        drop(self.cleaner.stdin.take());
        let _cleaned = self.cleaner.wait();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic, clippy::print_stderr, reason = "tests")]

    use std::process::Command;

    use super::*;

    /// Does a packet from `from` reach `to`? Sent and received by `bash` alone is not possible, so a TCP connection is tried
    /// to a port on which nobody listens: refused at once where both ways are open, nothing where one is not.
    fn answers(net: &Net, from: usize, to: usize) -> bool {
        let launcher = net.launcher(from);
        let (program, rest) = launcher.split_first().unwrap();
        let script = format!("exec 3<>/dev/tcp/{}/9", net.address(to));
        let output = Command::new("timeout")
            .args(["0.5", program])
            .args(rest)
            .args(["bash", "-c", &script])
            .output()
            .unwrap();
        // 124: the time was up.
        output.status.code() != Some(124)
    }

    #[test]
    fn a_cut_is_one_way_heals_and_leaves_the_others_alone() {
        let mut net = match Net::new(3) {
            Ok(net) => net,
            Err(error) if rustix::process::getuid().is_root() => panic!("as root it must work: {error}"),
            Err(error) => {
                eprintln!("NOT RUN: only root may make network namespaces: {error}");
                return;
            }
        };
        cuts_and_heals(&net);
        // Where nft is there, the other means as well.
        net.firewall = false;
        cuts_and_heals(&net);
        let space = net.space(0);
        drop(net);
        let left = Command::new("ip").args(["netns", "list"]).output().unwrap();
        assert!(!String::from_utf8_lossy(&left.stdout).contains(&space), "taken down");
    }

    fn cuts_and_heals(net: &Net) {
        let answers = |from, to| answers(net, from, to);
        assert!(answers(0, 1) && answers(1, 0) && answers(0, 2));
        net.cut(0, 1).unwrap();
        assert!(!answers(0, 1), "the question is lost");
        assert!(!answers(1, 0), "the answer is lost");
        assert!(answers(0, 2) && answers(2, 1));
        net.heal(0, 1).unwrap();
        assert!(answers(0, 1) && answers(1, 0));
    }
}
