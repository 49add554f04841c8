//! Every bound of this room, with its unit and its reason.

/// Servers of one host: each is a listener and a task.
pub const SERVERS_MAX: usize = 16;

/// Entries of one map: each address space has 65,536 addresses, and most values take two.
pub const ENTRIES_MAX: usize = 65_536;

/// Clients of one server at once: each may have one command under way.
pub const CONNECTIONS_RANGE: (usize, usize) = (1, 256);

/// Time without a whole request after which a client is closed, in s.
pub const IDLE_S_RANGE: (u64, u64) = (1, 86_400);

/// Time between two looks at points of other hosts, in ms.
pub const REFRESH_MS_RANGE: (u64, u64) = (50, 60_000);

/// Roles of a server or an entry: a plant has a handful.
pub(crate) const ROLES_MAX: usize = 16;
