//! What the API asks of what the cell trusts, as a trait: see `cell`.
//!
//! Never: adds a decision; [`Deploy`] is the only implementation outside of tests.

use bumpless_core::Digest;
use bumpless_deploy::{Deploy, SignaturesView, TrustView};
use bumpless_trust::{Sealed, Signature};

use crate::cell::Answer;

/// One host's way to what the cell trusts; see [`Deploy`] for what each method means.
pub(crate) trait Signing: Send + Sync + 'static {
    fn trust(&self) -> TrustView;
    fn put_trust(&self, sealed: Sealed) -> Answer<TrustView>;
    fn signatures(&self, digest: &Digest) -> SignaturesView;
    fn sign(&self, digest: Digest, signatures: Vec<Signature>) -> Answer<SignaturesView>;
}

impl Signing for Deploy {
    fn trust(&self) -> TrustView {
        self.trust()
    }

    fn put_trust(&self, sealed: Sealed) -> Answer<TrustView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.put_trust(sealed).await })
    }

    fn signatures(&self, digest: &Digest) -> SignaturesView {
        self.signatures(digest)
    }

    fn sign(&self, digest: Digest, signatures: Vec<Signature>) -> Answer<SignaturesView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.sign(digest, signatures).await })
    }
}
