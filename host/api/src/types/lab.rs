//! Reports of the lab that a host has in its folder.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// The reports that the answering host has, the newest first.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct LabReports {
    /// Has the host a folder of reports? Its configuration names it: `[lab] reports`.
    pub has_folder: bool,
    /// The reports.
    pub reports: Vec<LabReport>,
    /// Older ones that the answer leaves out.
    pub left_off: u64,
}

/// One report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct LabReport {
    /// Name of the experiment.
    pub name: String,
    /// Its files, each to be asked for by its name; the first one is the page for people.
    pub files: Vec<String>,
    /// Bytes of the page.
    pub bytes: u64,
    /// When the page was written, in ms of Unix time.
    pub written_unix_ms: u64,
}
