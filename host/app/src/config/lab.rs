//! The lab's table of the configuration: where its reports lie, for the operator's page.
//!
//! Never: opens the folder; it may come later.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// `[lab]`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct LabTable {
    #[serde(skip_serializing_if = "Option::is_none")]
    reports: Option<PathBuf>,
}

impl LabTable {
    /// The folder of reports, counted from the file's own.
    pub(super) fn reports(self, folder: &Path) -> Option<PathBuf> {
        self.reports.map(|reports| folder.join(reports))
    }
}
