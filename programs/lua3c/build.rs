//! Gives the interpreter a stack: it calls itself for each call of its script that goes through a metamethod or a protected call.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    if std::env::var("CARGO_CFG_TARGET_ARCH").is_ok_and(|arch| arch == "wasm32") {
        // 256 KiB; the workspace's own 16 KiB are for laws.
        println!("cargo:rustc-link-arg-cdylib=-zstack-size=262144");
    }
}
