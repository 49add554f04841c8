//! One cycle a page, forth and back by key.
//!
//! Never: leaves the terminal in disorder; it is restored on every way out.

use std::time::Duration;

use ratatui::{
    crossterm::event::{self, Event as Input, KeyCode, KeyEventKind, KeyModifiers},
    layout::{Constraint, Layout},
    style::{Modifier, Style},
    text::{Line, Span},
    widgets::Paragraph,
};

use super::Window;
use crate::error::Error;

/// Longest wait for a key before the picture is drawn again, for a terminal that changed its size.
const DRAWN_EVERY: Duration = Duration::from_millis(500);
/// Cycles that the large keys pass.
const LEAP: usize = 10;

/// What a key does.
#[derive(Debug, PartialEq, Eq)]
enum Step {
    To(usize),
    Scroll(i32),
    Quit,
    Nothing,
}

/// Shows cycles until the reader quits.
pub(super) fn run(window: &mut Window, first: usize) -> Result<(), Error> {
    let failed = |source| Error::Terminal {
        action: "drawn on",
        source,
    };
    let mut terminal = ratatui::try_init().map_err(failed)?;
    let (mut at, mut scroll) = (first, 0_u16);
    let mut page = window.lines(at);
    let end = loop {
        let place = format!("{} of {}", at + 1, window.records.len());
        if let Err(error) = terminal
            .draw(|frame| draw(frame, &page, scroll, &place))
            .map_err(failed)
        {
            break Err(error);
        }
        let step = match key(window, at) {
            Ok(step) => step,
            Err(error) => break Err(failed(error)),
        };
        match step {
            Step::To(next) if next != at => {
                (at, scroll) = (next, 0);
                page = window.lines(at);
            }
            Step::Scroll(by) => {
                let most = i32::try_from(page.len()).unwrap_or(i32::MAX).saturating_sub(1);
                scroll = u16::try_from((i32::from(scroll) + by).clamp(0, most.max(0))).unwrap_or(0);
            }
            Step::Quit => break Ok(()),
            Step::To(_) | Step::Nothing => {}
        }
    };
    ratatui::restore();
    end
}

fn key(window: &Window, at: usize) -> std::io::Result<Step> {
    if !event::poll(DRAWN_EVERY)? {
        return Ok(Step::Nothing);
    }
    match event::read()? {
        Input::Key(key) if key.kind == KeyEventKind::Press => {
            let control = key.modifiers.contains(KeyModifiers::CONTROL);
            Ok(meaning(window, at, key.code, control))
        }
        _ => Ok(Step::Nothing),
    }
}

fn meaning(window: &Window, at: usize, code: KeyCode, control: bool) -> Step {
    let last = window.records.len().saturating_sub(1);
    match code {
        KeyCode::Char('c') if control => Step::Quit,
        KeyCode::Char('q') | KeyCode::Esc => Step::Quit,
        KeyCode::Char('n' | ' ') | KeyCode::Right | KeyCode::Enter => Step::To((at + 1).min(last)),
        KeyCode::Char('p') | KeyCode::Left | KeyCode::Backspace => Step::To(at.saturating_sub(1)),
        KeyCode::PageDown => Step::To((at + LEAP).min(last)),
        KeyCode::PageUp => Step::To(at.saturating_sub(LEAP)),
        KeyCode::Home => Step::To(0),
        KeyCode::End => Step::To(last),
        KeyCode::Char('e') => window.notable(at, false).map_or(Step::Nothing, Step::To),
        KeyCode::Char('E') => window.notable(at, true).map_or(Step::Nothing, Step::To),
        KeyCode::Down => Step::Scroll(1),
        KeyCode::Up => Step::Scroll(-1),
        _ => Step::Nothing,
    }
}

fn draw(frame: &mut ratatui::Frame<'_>, page: &[String], scroll: u16, place: &str) {
    let [body, foot] = Layout::vertical([Constraint::Fill(1), Constraint::Length(1)]).areas(frame.area());
    let strong = Style::new().add_modifier(Modifier::BOLD);
    let lines: Vec<Line<'_>> = page
        .iter()
        .enumerate()
        .map(|(n, text)| {
            let title = n == 0 || !text.starts_with(' ');
            Line::from(Span::styled(text.as_str(), if title { strong } else { Style::new() }))
        })
        .collect();
    frame.render_widget(Paragraph::new(lines).scroll((scroll, 0)), body);
    let keys = format!("{place}   n next  p previous  PgDn PgUp by {LEAP}  e E to a happening  ↑ ↓ scroll  q quit");
    let dim = Style::new().add_modifier(Modifier::DIM);
    frame.render_widget(Paragraph::new(Line::from(Span::styled(keys, dim))), foot);
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use ratatui::{Terminal, backend::TestBackend};

    use super::*;

    #[test]
    fn keys_go_through_the_window_and_not_beyond() {
        let window = Window {
            name: "x".to_owned(),
            records: Vec::new(),
            known: BTreeMap::new(),
            again: None,
        };
        for (code, control, step) in [
            (KeyCode::Char('n'), false, Step::To(0)),
            (KeyCode::Char('p'), false, Step::To(0)),
            (KeyCode::End, false, Step::To(0)),
            (KeyCode::Char('e'), false, Step::Nothing),
            (KeyCode::Char('c'), true, Step::Quit),
            (KeyCode::Char('c'), false, Step::Nothing),
            (KeyCode::Esc, false, Step::Quit),
            (KeyCode::Up, false, Step::Scroll(-1)),
        ] {
            assert_eq!(meaning(&window, 0, code, control), step, "{code:?}");
        }
    }

    #[test]
    fn a_page_is_drawn_with_its_place() {
        let mut terminal = Terminal::new(TestBackend::new(90, 6)).expect("a terminal in memory");
        let page = ["pressure  cycle 8", "read", "  pv  0.5"].map(str::to_owned);
        terminal
            .draw(|frame| draw(frame, &page, 1, "2 of 3"))
            .expect("memory can be drawn on");
        let text = terminal.backend().to_string();
        assert!(
            text.contains("pv  0.5") && text.contains("2 of 3   n next") && !text.contains("cycle 8"),
            "{text}"
        );
    }
}
