//! Colours and layout of the page, as one style sheet.
//!
//! Pictures are drawn with the colours of [`INKS`]; the sheet replaces them by the reader's, light or dark.
//! Never: a font, picture or script from elsewhere.

/// An ink of pictures: what is drawn, and what it becomes in the light and in the dark.
pub(crate) struct Ink {
    pub(crate) rgb: (u8, u8, u8),
    light: &'static str,
    dark: &'static str,
}

const fn ink(n: u8, light: &'static str, dark: &'static str) -> Ink {
    // Each ink is a colour of its own that no picture needs otherwise, so that the sheet can find it.
    Ink {
        rgb: (n, 1, 2),
        light,
        dark,
    }
}

/// Paper, lines and text.
pub(crate) const PAPER: Ink = ink(1, "#ffffff", "#16191d");
pub(crate) const LINE: Ink = ink(2, "#dfe3e8", "#31373f");
pub(crate) const TEXT: Ink = ink(3, "#4a5460", "#a9b3bf");
/// What is wanted.
pub(crate) const WANTED: Ink = ink(4, "#8a94a0", "#8a94a0");
/// What happens.
pub(crate) const EVENT: Ink = ink(5, "#c2410c", "#fb923c");

/// One per case; told apart by people who see red and green alike (Okabe and Ito 2008, darker on paper).
pub(crate) const INKS: [Ink; 8] = [
    ink(10, "#0072b2", "#56b4e9"),
    ink(11, "#d55e00", "#ff9440"),
    ink(12, "#009e73", "#2fd3a5"),
    ink(13, "#a8518a", "#e59ac8"),
    ink(14, "#7a5c00", "#e6c229"),
    ink(15, "#5b4bc4", "#a79cff"),
    ink(16, "#3f7f1f", "#8fd460"),
    ink(17, "#8c2f39", "#f2808c"),
];

/// The ink of a case.
pub(crate) fn of(n: usize) -> &'static Ink {
    &INKS[n % INKS.len()]
}

fn rules(dark: bool) -> String {
    let all = [&PAPER, &LINE, &TEXT, &WANTED, &EVENT].into_iter().chain(&INKS);
    all.map(|ink| {
        let (r, g, b) = ink.rgb;
        let (from, to) = (
            format!("#{r:02X}{g:02X}{b:02X}"),
            if dark { ink.dark } else { ink.light },
        );
        format!("svg [fill=\"{from}\"]{{fill:{to}}}svg [stroke=\"{from}\"]{{stroke:{to}}}\n")
    })
    .collect()
}

/// Colour of a case outside pictures.
fn swatches(dark: bool) -> String {
    let all = INKS.iter().enumerate();
    all.map(|(n, ink)| format!(".c{n}{{background:{}}}", if dark { ink.dark } else { ink.light }))
        .collect()
}

/// The style sheet.
pub(crate) fn sheet() -> String {
    let (light, dark) = (rules(false) + &swatches(false), rules(true) + &swatches(true));
    format!(
        r#":root{{color-scheme:light dark;--paper:#fff;--ground:#f5f6f8;--text:#1c2229;--soft:#5b6570;--line:#dfe3e8;--best:#e6f4ec}}
{light}
@media (prefers-color-scheme:dark){{:root{{--paper:#16191d;--ground:#0e1013;--text:#e7ebef;--soft:#98a2ae;--line:#31373f;--best:#12301f}}
{dark}}}
@media print{{:root{{--paper:#fff;--ground:#fff;--text:#000;--soft:#444;--line:#bbb;--best:#eee}}
{light} section{{break-inside:avoid;box-shadow:none!important}} body{{font-size:10pt}} }}
*{{box-sizing:border-box}}
body{{margin:0 auto;padding:2rem 1.25rem 4rem;max-width:1080px;background:var(--ground);color:var(--text);font:15px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"Noto Sans",sans-serif}}
h1{{font-size:1.75rem;line-height:1.2;margin:0 0 .35rem;letter-spacing:-.015em}}
h2{{font-size:1.15rem;margin:0 0 .75rem}}
h3{{font-size:.95rem;margin:1.25rem 0 .4rem;color:var(--soft);font-weight:600}}
p{{margin:.3rem 0;max-width:72ch}} .soft{{color:var(--soft)}}
section{{background:var(--paper);border:1px solid var(--line);border-radius:10px;padding:1.1rem 1.25rem 1.25rem;margin:1.1rem 0;overflow-x:auto}}
svg{{width:100%;height:auto;display:block;font-family:inherit}}
svg text{{font-family:system-ui,-apple-system,"Segoe UI",Roboto,"Noto Sans",sans-serif}}
table{{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.88rem;width:100%}}
th,td{{text-align:right;padding:.3rem .55rem;border-bottom:1px solid var(--line);white-space:nowrap}}
th:first-child,td:first-child{{text-align:left}} thead th{{color:var(--soft);font-weight:600;border-bottom-width:2px}}
td.best{{background:var(--best);font-weight:600}}
.key{{display:inline-flex;align-items:center;gap:.4rem;margin:0 1rem .3rem 0;font-size:.88rem}}
.key i{{width:1.1rem;height:.28rem;border-radius:2px;display:inline-block}}
.key i.wanted{{background:#8a94a0}} .key i.event{{width:.2rem;height:.9rem;background:#c2410c}}
ul{{margin:.3rem 0;padding-left:1.1rem;columns:2;font-size:.85rem;color:var(--soft)}}
@media (max-width:720px){{ul{{columns:1}}}}
footer{{color:var(--soft);font-size:.82rem;margin-top:1.5rem}}"#
    )
}
