//! Why a key, a signature or a document is not taken. Each message names what, and the cure.

/// Everything that this room refuses.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// A key file.
    #[error("this is no key file: {0}")]
    KeyFile(String),
    /// The passphrase, or a file that was changed: the two cannot be told apart.
    #[error("the key does not open: the passphrase is wrong, or the file was changed")]
    Passphrase,
    /// The system gives no random numbers.
    #[error("no key can be drawn: the system gives no random numbers")]
    Random,
    /// A text beyond its measure.
    #[error("{what} {text:?}: {cure}")]
    Text {
        /// What it is.
        what: &'static str,
        /// The text, cut.
        text: String,
        /// How it should be.
        cure: &'static str,
    },
    /// A document.
    #[error("this is no document of trust: {0}")]
    Document(String),
    /// A document that must not replace the one in force.
    #[error("the document does not replace the one in force: {0}")]
    Replace(String),
    /// A signature.
    #[error("the signature of key {key} is not taken: {reason}")]
    Signature {
        /// The key that it names.
        key: String,
        /// Why.
        reason: String,
    },
}
