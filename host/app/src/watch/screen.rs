//! A loop as a picture in the terminal: trend, who stepped in each cycle, indices, what happened.
//!
//! Draws at most ten times a second, whatever the loop's period. Never: leaves the terminal in disorder; it is restored on
//! every way out, a panic included.

use std::{
    sync::mpsc::Receiver,
    time::{Duration, Instant},
};

use ratatui::{
    Frame,
    crossterm::event::{self, Event as Input, KeyCode, KeyEventKind, KeyModifiers},
    layout::{Constraint, Layout, Rect},
    style::{Color, Modifier, Style},
    symbols::Marker,
    text::{Line, Span},
    widgets::{Axis, Block, Chart, Dataset, GraphType, Paragraph, Wrap},
};

use super::{
    dev::Said,
    feed::{Feed, News},
    story::Story,
};
use crate::{error::Error, show};

/// Time between two pictures.
const FRAME: Duration = Duration::from_millis(100);

/// Colours of hosts, by their place among the names.
const COLORS: [Color; 6] = [
    Color::Cyan,
    Color::Yellow,
    Color::Magenta,
    Color::Green,
    Color::Blue,
    Color::Red,
];

/// Draws until `cycles` are seen or the reader quits; or until builds end, where somebody builds.
pub(super) fn run(
    feed: &Feed,
    mut story: Story,
    cycles: Option<u64>,
    builds: Option<&Receiver<Said>>,
) -> Result<(), Error> {
    let failed = |source| Error::Terminal {
        action: "drawn on",
        source,
    };
    let mut terminal = ratatui::try_init().map_err(failed)?;
    let end = (|| {
        loop {
            terminal.draw(|frame| draw(frame, &story)).map_err(failed)?;
            if let Some(end) = builds.and_then(|builds| hear(&mut story, builds)) {
                return end;
            }
            let next = Instant::now() + FRAME;
            while let Some(left) = next.checked_duration_since(Instant::now()) {
                match feed.next(left.min(Duration::from_millis(20))) {
                    Some(News::Gone(reason)) => return Err(story.gone(&reason)),
                    Some(news) => take(&mut story, news),
                    None if keys(&mut story).map_err(failed)? => return Ok(()),
                    None => {}
                }
            }
            if keys(&mut story).map_err(failed)? || cycles.is_some_and(|cycles| story.cycles >= cycles) {
                return Ok(());
            }
        }
    })();
    ratatui::restore();
    end
}

/// Takes what became of builds; how they ended, where they did.
fn hear(story: &mut Story, builds: &Receiver<Said>) -> Option<Result<(), Error>> {
    while let Ok(said) = builds.try_recv() {
        match said {
            Said::Begun => story.build = Some(vec!["building …".to_owned()]),
            Said::Done(text) => {
                story.now(&text);
                story.build = Some(vec![text]);
            }
            Said::Wrong(text) => {
                story.now("the build is not in force");
                story.build = Some(text.lines().map(str::to_owned).collect());
            }
            Said::Ended(end) => return Some(end),
        }
    }
    None
}

fn take(story: &mut Story, news: News) {
    match news {
        News::Record(record, _) => story.record(*record),
        News::Hosts(hosts) => story.hosts(hosts),
        News::Alarm(event, _) => story.alarm(&event),
        News::Lost(records) => story.lost(records),
        News::Connected(api) => story.connected(api),
        News::Disconnected(reason) | News::Gone(reason) => story.disconnected(&reason),
    }
}

/// Takes what was typed; true to quit.
fn keys(story: &mut Story) -> std::io::Result<bool> {
    while event::poll(Duration::ZERO)? {
        if let Input::Key(key) = event::read()?
            && key.kind == KeyEventKind::Press
        {
            match key.code {
                KeyCode::Char('q') | KeyCode::Esc => return Ok(true),
                KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => return Ok(true),
                KeyCode::Char('r') => story.reset_indices(),
                _ => {}
            }
        }
    }
    Ok(false)
}

/// The whole picture.
fn draw(frame: &mut Frame<'_>, story: &Story) {
    // Two lines of a frame, and the text; what a compiler says beyond that is in the text's first lines.
    let middle = story.build.as_ref().map_or(4, |lines| lines.len().clamp(2, 12) + 2);
    let rows = Layout::vertical([
        Constraint::Length(3),
        Constraint::Fill(3),
        Constraint::Fill(1),
        Constraint::Length(u16::try_from(middle).unwrap_or(4)),
        Constraint::Length(8),
        Constraint::Length(1),
    ]);
    let [head, trend, output, steppers, happenings, foot] = rows.areas(frame.area());
    frame.render_widget(Paragraph::new(heading(story)), head);
    draw_trend(frame, story, trend);
    draw_output(frame, story, output);
    match &story.build {
        Some(lines) => {
            let text: Vec<Line<'_>> = lines.iter().map(|line| Line::raw(line.as_str())).collect();
            let block = Block::bordered().title(" build ");
            frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: false }).block(block), steppers);
        }
        None => draw_steppers(frame, story, steppers),
    }
    let block = Block::bordered().title(" what happened ");
    let room = usize::from(block.inner(happenings).height);
    let skip = story.happenings.len().saturating_sub(room);
    let lines: Vec<Line<'_>> = story
        .happenings
        .iter()
        .skip(skip)
        .map(|text| Line::raw(text.as_str()))
        .collect();
    frame.render_widget(Paragraph::new(lines).block(block), happenings);
    let keys = Span::styled(
        "q quit   r restart the indices",
        Style::new().add_modifier(Modifier::DIM),
    );
    frame.render_widget(Paragraph::new(Line::from(keys)), foot);
}

fn heading(story: &Story) -> Vec<Line<'_>> {
    let strong = Style::new().add_modifier(Modifier::BOLD);
    let (mode, setpoint) = story.in_force();
    let last = story.last.as_ref();
    vec![
        Line::from(vec![
            Span::styled(story.name.as_str(), strong),
            Span::raw(format!(
                "  {}  {}  every {} ms  {} over {}  home {}",
                story.component,
                mode.map_or("–", |mode| mode.name()),
                show::number(story.period_ms),
                story.strategy,
                story.members.join(" "),
                story.home
            )),
        ]),
        Line::raw(format!(
            "setpoint {}  measured {}  output {}   owner {} term {}  cycle {}",
            show::with_unit(setpoint, &story.unit),
            show::with_unit(last.and_then(|r| r.measurement), &story.unit),
            show::maybe(last.and_then(|r| r.outputs.values().next().copied().flatten())),
            last.map_or("–", |r| r.owner.as_str()),
            last.map_or(0, |r| r.term),
            last.map_or(0, |r| r.seq),
        )),
        Line::raw(format!(
            "{}   seen {}  missing {}  takeovers {}{}",
            story.indices_line(),
            story.cycles,
            story.missing,
            story.takeovers,
            if story.dropped > 0 {
                format!("  not seen {}", story.dropped)
            } else {
                String::new()
            }
        )),
    ]
}

/// Bounds with a little air, never empty.
fn bounds(values: impl Iterator<Item = f64>) -> [f64; 2] {
    let (low, high) = values
        .filter(|v| v.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
            (low.min(v), high.max(v))
        });
    if !low.is_finite() {
        return [0.0, 1.0];
    }
    let air = ((high - low) * 0.1).max(high.abs() * 0.01).max(1e-6);
    [low - air, high + air]
}

fn axis<'a>([low, high]: [f64; 2]) -> Axis<'a> {
    Axis::default().bounds([low, high]).labels([
        show::number(low),
        show::number(f64::midpoint(low, high)),
        show::number(high),
    ])
}

fn line<'a>(name: &'a str, points: &'a [(f64, f64)], color: Color) -> Dataset<'a> {
    Dataset::default()
        .name(name)
        .marker(Marker::Braille)
        .graph_type(GraphType::Line)
        .style(Style::new().fg(color))
        .data(points)
}

fn time_axis<'a>(story: &Story) -> Axis<'a> {
    let first = story.samples.front().map_or(0.0, |s| s.t_s);
    let last = story.samples.back().map_or(1.0, |s| s.t_s).max(first + 1.0);
    Axis::default()
        .bounds([first, last])
        .labels([format!("{first:.0} s"), format!("{last:.0} s")])
}

fn draw_trend(frame: &mut Frame<'_>, story: &Story, area: Rect) {
    let setpoint: Vec<_> = story.samples.iter().map(|s| (s.t_s, s.setpoint)).collect();
    let measured: Vec<_> = story.samples.iter().map(|s| (s.t_s, s.measurement)).collect();
    let y = bounds(setpoint.iter().chain(&measured).map(|p| p.1));
    let title = if story.unit.is_empty() {
        " measured ".to_owned()
    } else {
        format!(" measured, {} ", story.unit)
    };
    let chart = Chart::new(vec![
        line("setpoint", &setpoint, Color::DarkGray),
        line("measured", &measured, Color::Green),
    ])
    .block(Block::bordered().title(title))
    .x_axis(time_axis(story))
    .y_axis(axis(y));
    frame.render_widget(chart, area);
}

fn draw_output(frame: &mut Frame<'_>, story: &Story, area: Rect) {
    let output: Vec<_> = story
        .samples
        .iter()
        .filter(|s| s.output.is_finite())
        .map(|s| (s.t_s, s.output))
        .collect();
    let y = bounds(output.iter().map(|p| p.1));
    let chart = Chart::new(vec![line("", &output, Color::Yellow)])
        .block(Block::bordered().title(" output "))
        .x_axis(time_axis(story))
        .y_axis(axis(y));
    frame.render_widget(chart, area);
}

/// One mark per cycle in the colour of the host that stepped.
fn draw_steppers(frame: &mut Frame<'_>, story: &Story, area: Rect) {
    let color = |host: &str| {
        let place = story.steps.keys().position(|known| known == host).unwrap_or_default();
        COLORS[place % COLORS.len()]
    };
    let block = Block::bordered().title(" who stepped, newest right ");
    let room = usize::from(block.inner(area).width);
    let skip = story.steppers.len().saturating_sub(room);
    let marks: Vec<Span<'_>> = story
        .steppers
        .iter()
        .skip(skip)
        .map(|host| Span::styled("▮", Style::new().fg(color(host))))
        .collect();
    let total = story.cycles.max(1) as f64;
    let mut names = Vec::new();
    for (host, steps) in &story.steps {
        let part = *steps as f64 / total * 100.0;
        let state = match story.hosts.iter().find(|known| known.name == *host) {
            Some(known) if !known.alive => " gone",
            Some(known) if known.draining => " draining",
            _ => "",
        };
        names.push(Span::styled(format!("▮ {host}{state}"), Style::new().fg(color(host))));
        names.push(Span::raw(format!(" {steps} ({part:.0} %)   ")));
    }
    frame.render_widget(
        Paragraph::new(vec![Line::from(marks), Line::from(names)]).block(block),
        area,
    );
}

#[cfg(test)]
mod tests {
    use ratatui::{Terminal, backend::TestBackend};

    use super::*;
    use crate::watch::story::tests::{record, story};

    fn picture(story: &Story, width: u16, height: u16) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).expect("a terminal in memory");
        terminal
            .draw(|frame| draw(frame, story))
            .expect("memory can be drawn on");
        terminal.backend().to_string()
    }

    #[test]
    fn a_picture_shows_the_loop_its_hosts_and_what_happened() {
        let mut story = story();
        for seq in 1..30 {
            story.record(record(seq, ["a", "b", "c"][seq as usize % 3], &serde_json::json!([])));
        }
        story.record(record(
            30,
            "b",
            &serde_json::json!([{"kind": "took-over", "from": "a"}]),
        ));
        let text = picture(&story, 120, 40);
        for part in [
            "pressure",
            "setpoint 1 bar",
            "measured 0.5 bar",
            "owner a term 1  cycle 30",
            "IAE",
            "▮ b 11 (37 %)",
            "took over from a",
        ] {
            assert!(text.contains(part), "{part} is not in\n{text}");
        }
    }

    #[test]
    fn what_becomes_of_a_build_is_shown() {
        let mut story = story();
        story.record(record(1, "a", &serde_json::json!([])));
        let (sender, builds) = std::sync::mpsc::sync_channel(8);
        let wrong = (0..40).map(|n| format!("law.st:{n}:6: there is no variable X{n}"));
        for said in [
            Said::Begun,
            Said::Done("law@0.0.1 is in force 0.30 s after the save".to_owned()),
            Said::Wrong(wrong.collect::<Vec<_>>().join("\n")),
        ] {
            sender.send(said).expect("room");
        }
        assert!(hear(&mut story, &builds).is_none());
        let text = picture(&story, 120, 40);
        for part in [
            "law.st:0:6: there is no variable X0",
            "X11",
            "law@0.0.1 is in force",
            "the build is not in force",
            "build",
        ] {
            assert!(text.contains(part), "{part} is not in\n{text}");
        }
        sender.send(Said::Ended(Ok(()))).expect("room");
        assert!(matches!(hear(&mut story, &builds), Some(Ok(()))));
        picture(&story, 9, 4);
    }

    #[test]
    fn no_data_and_no_room_are_no_failure() {
        picture(&story(), 120, 40);
        picture(&story(), 3, 2);
        let mut story = story();
        story.record(record(1, "a", &serde_json::json!([])));
        picture(&story, 20, 5);
        assert_eq!(bounds([f64::NAN].into_iter()), [0.0, 1.0]);
        assert!(bounds([2.0].into_iter())[0] < 2.0);
    }
}
