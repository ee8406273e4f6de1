//! A scan by hand: which units answer on a line of which perhaps nothing is known, and who they are.
//!
//! It only reads: names (function 43/14), server ids (17), and registers that profiles go by; a unit that
//! does not know function 43 and is silent to it is asked for a register.
//!
//! Settings are tried one after the other, the likeliest first, at first with the units that are likely;
//! once a unit has answered, only its settings are right, and all units are asked there. A unit that may not
//! be there is waited for as short as can be. What is heard too late or damaged is asked again with all
//! patience; who then answers damaged again is no device, but told with what may be the cause.

mod lines;
mod report;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use crate::engine::identity::{ANY_REGISTER, Interview, Known};
use crate::engine::modbus::{Call, Discarded, Reply, Request, RequestError};
use crate::engine::settings::Line;
use crate::engine::time::{Duration, Time};

pub use lines::{SPECIFIED, lines};
pub use report::Report;

/// Units up to this are asked at all settings before others are.
const LIKELY_UNITS: u8 = 32;
/// A late answer may be that of any of so many units that were asked last.
const RECENT: usize = 4;
/// So often a unit whose answer was damaged is asked again.
const LOOKS_AGAIN: u32 = 2;
/// Of a request for names, with its checksum.
const REQUEST_CHARACTERS: u32 = 7;
/// A gateway asks its own line, and tells of silence there only when its own patience ends.
const TCP_TIMEOUT: Duration = Duration::from_secs(1);
/// Behind the last unit nobody is asked in whose time a late answer would be heard.
const LAST_TIMEOUT: Duration = Duration::from_millis(300);
/// With this patience a unit is asked again, and who it is.
const PATIENCE: Duration = Duration::from_millis(500);

/// What is to be found out.
#[derive(Clone, Debug)]
pub struct Wanted {
    /// The settings to try; of Modbus TCP none.
    pub lines: Vec<Line>,
    pub units: Vec<u8>,
    pub known: Known,
    /// Profiles of devices that tell nobody who they are.
    pub nameless: Vec<String>,
    /// How long a unit is waited for, where somebody wants it longer than usual.
    pub timeout: Option<Duration>,
    /// Whether there is a server behind the link that may close its connections.
    pub of_server: bool,
}

/// One question for the line.
#[derive(Clone, Debug)]
pub struct Question {
    /// With these settings; `None` on Modbus TCP.
    pub line: Option<Line>,
    pub request: Request,
    pub timeout: Duration,
}

/// A scan under way: ask [`Scan::next_question`], tell [`Scan::answered`], [`Scan::not_opened`] or [`Scan::lost`], until
/// there is no question any more.
#[derive(Debug)]
pub struct Scan {
    wanted: Wanted,
    stages: VecDeque<Stage>,
    /// The line on which somebody has answered.
    settled: Option<Option<Line>>,
    asked: Option<Asked>,
    /// On the connection as it is now something has been asked, and it has outlived that.
    has_asked_here: bool,
    /// The question that went with a connection, which is asked once more on the next one.
    once_more: Option<Question>,
    /// How many questions ended the connection that was made for them.
    hung_up: u32,
    interview: Option<(u8, Interview)>,
    /// How often the interview's question has been damaged.
    repeated: u32,
    /// To be asked again, and how often it has been.
    again: VecDeque<(u8, u32)>,
    recent: VecDeque<u8>,
    /// The shortest time until an answer began.
    quickest: Option<Duration>,
    found: BTreeMap<u8, Found>,
    /// How often each unit has answered for the first time.
    met: BTreeMap<u8, u32>,
    /// How many answers of each unit were damaged.
    damaged: BTreeMap<u8, u32>,
    /// Units that a gateway says are not there.
    absent: BTreeSet<u8>,
    garbled: Vec<Garbled>,
    other_masters: Option<u8>,
    noise: u32,
    news: VecDeque<String>,
    questions: u32,
    /// The one that was asked last.
    unit: Option<u8>,
}

/// Some units on one line, asked in one way.
#[derive(Clone, Debug)]
struct Stage {
    line: Option<Line>,
    how: How,
    units: VecDeque<u8>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum How {
    /// Function 43/14 changes nothing on any device.
    Names,
    /// Whoever is silent to what it does not know says something to this.
    Register,
}

/// What is on the line.
#[derive(Clone, Copy, Debug)]
enum Asked {
    Sweep(u8),
    Again(u8, u32),
    Interview,
}

/// A unit that answers.
#[derive(Debug)]
struct Found {
    interview: Interview,
    /// How many of its answers were damaged.
    damaged: u32,
}

/// Somebody answers there, but not so that it could be understood.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Garbled {
    line: Option<Line>,
    unit: u8,
    what: RequestError,
}

/// How far a scan is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    pub line: Option<Line>,
    pub unit: Option<u8>,
    /// Questions so far.
    pub questions: u32,
    /// It takes no longer than this if nobody answers any more.
    pub at_most: Duration,
}

impl Scan {
    pub fn new(wanted: Wanted) -> Scan {
        let lines: Vec<Option<Line>> = match wanted.lines.is_empty() {
            true => vec![None],
            false => wanted.lines.iter().copied().map(Some).collect(),
        };
        let (likely, rest): (Vec<u8>, Vec<u8>) = match lines.len() {
            1 => (wanted.units.clone(), Vec::new()),
            _ => wanted.units.iter().partition(|unit| **unit <= LIKELY_UNITS),
        };
        let mut stages = VecDeque::new();
        for units in [likely, rest] {
            for how in [How::Names, How::Register] {
                let stage = |line| Stage { line, how, units: units.iter().copied().collect() };
                stages.extend(lines.iter().copied().map(stage));
            }
        }
        Scan {
            wanted,
            stages,
            settled: None,
            asked: None,
            has_asked_here: false,
            once_more: None,
            hung_up: 0,
            interview: None,
            repeated: 0,
            again: VecDeque::new(),
            recent: VecDeque::new(),
            quickest: None,
            found: BTreeMap::new(),
            met: BTreeMap::new(),
            damaged: BTreeMap::new(),
            absent: BTreeSet::new(),
            garbled: Vec::new(),
            other_masters: None,
            noise: 0,
            news: VecDeque::new(),
            questions: 0,
            unit: None,
        }
    }

    /// What to ask next; `None`: it is over.
    pub fn next_question(&mut self) -> Option<Question> {
        let question = self.once_more.take().or_else(|| self.pick())?;
        self.questions += 1;
        self.unit = Some(question.request.unit);
        Some(question)
    }

    fn pick(&mut self) -> Option<Question> {
        if let Some((unit, call)) =
            self.interview.as_ref().and_then(|(unit, interview)| Some((*unit, interview.question()?)))
        {
            self.asked = Some(Asked::Interview);
            return Some(self.patiently(unit, call));
        }
        while let Some((unit, looks)) = self.again.pop_front() {
            // It may have answered meanwhile.
            if self.is_known(self.line(), unit) {
                continue;
            }
            self.asked = Some(Asked::Again(unit, looks));
            let how = self.stages.front().map_or(How::Names, |stage| stage.how);
            return Some(self.patiently(unit, how.call()));
        }
        loop {
            let stage = self.stages.front_mut()?;
            let Some(unit) = stage.units.pop_front() else {
                self.recent.clear();
                if self.stages.len() == 1 {
                    return None;
                }
                self.stages.pop_front();
                continue;
            };
            let (line, how) = (stage.line, stage.how);
            if self.is_known(line, unit) {
                continue;
            }
            self.asked = Some(Asked::Sweep(unit));
            self.recent.push_back(unit);
            if self.recent.len() > RECENT {
                self.recent.pop_front();
            }
            let is_last = self.stages.front().is_none_or(|stage| stage.units.is_empty());
            let request = Request { is_probe: true, ..Request::new(unit, how.call()) };
            let short = self.short_timeout(line);
            let timeout = if is_last { short.max(LAST_TIMEOUT) } else { short };
            return Some(Question { line, request, timeout });
        }
    }

    /// The line that is being asked now.
    fn line(&self) -> Option<Line> {
        self.stages.front().and_then(|stage| stage.line)
    }

    fn is_known(&self, line: Option<Line>, unit: u8) -> bool {
        let is_garbled = self.garbled.iter().any(|garbled| garbled.line == line && garbled.unit == unit);
        self.found.contains_key(&unit) || self.absent.contains(&unit) || is_garbled
    }

    fn patiently(&self, unit: u8, call: Call) -> Question {
        let line = self.line();
        Question { line, request: Request::new(unit, call), timeout: self.patience(line) }
    }

    fn patience(&self, line: Option<Line>) -> Duration {
        PATIENCE.max(self.short_timeout(line))
    }

    fn short_timeout(&self, line: Option<Line>) -> Duration {
        let usual = line.map_or(TCP_TIMEOUT, lines::short_timeout);
        // Where even the quickest is slow, it is the way to them.
        let quickest = self.quickest.unwrap_or_default();
        self.wanted.timeout.unwrap_or_else(|| usual.max((quickest * 2).min(PATIENCE)))
    }

    /// What the line did with the question.
    pub fn answered(&mut self, reply: &Reply) {
        self.has_asked_here = true;
        let heard = &reply.discarded;
        if heard.requests_of_others.count > 0 && self.other_masters.is_none() {
            self.other_masters = Some(heard.requests_of_others.unit);
            self.news.push_back(report::OTHER_MASTER.into());
        }
        self.noise = self.noise.saturating_add(heard.noise_bytes);
        let is_heard = matches!(reply.result, Ok(_) | Err(RequestError::Exception(_)));
        if let (true, Some(first)) = (is_heard, reply.first_byte_at) {
            let took = first.since(reply.sent_at);
            self.quickest = Some(self.quickest.map_or(took, |quickest| quickest.min(took)));
        }
        match self.asked.take() {
            Some(Asked::Interview) => self.told(reply),
            Some(Asked::Sweep(unit)) => {
                match &reply.result {
                    _ if is_heard => self.meet(unit),
                    Err(RequestError::Unreachable(_)) => drop(self.absent.insert(unit)),
                    Err(RequestError::Timeout | RequestError::Link(_)) | Ok(_) => {}
                    Err(_) => self.look_again(unit, 0),
                }
                // Somebody was late, and may have been spoken over.
                if heard.late_replies + heard.foreign_frames > 0 {
                    let recent = std::mem::take(&mut self.recent);
                    recent.into_iter().for_each(|unit| self.look_again(unit, 0));
                }
            }
            Some(Asked::Again(unit, looks)) => match &reply.result {
                _ if is_heard => self.meet(unit),
                Err(RequestError::Unreachable(_) | RequestError::Timeout | RequestError::Link(_)) | Ok(_) => {
                }
                Err(_) if looks < LOOKS_AGAIN => self.look_again(unit, looks + 1),
                Err(what) => self.give_up(unit, what.clone()),
            },
            None => {}
        }
        // However late it was: it says itself whose it is.
        if let Some(late) = heard.late {
            self.look_again(late.unit, 0);
        }
    }

    fn look_again(&mut self, unit: u8, looks: u32) {
        let waits = self.again.iter().any(|(waiting, _)| *waiting == unit);
        if !waits && !self.is_known(self.line(), unit) && self.wanted.units.contains(&unit) {
            self.again.push_back((unit, looks));
        }
    }

    /// Somebody is there.
    fn meet(&mut self, unit: u8) {
        if self.settled.is_none() {
            self.settle();
        }
        *self.met.entry(unit).or_default() += 1;
        self.repeated = 0;
        self.interview = Some((unit, Interview::of_stranger(self.wanted.known.clone())));
    }

    /// These are the line's settings: all units are asked there, and nowhere else.
    fn settle(&mut self) {
        let line = self.line();
        self.settled = Some(line);
        let here = self.stages.front().map(|stage| stage.how);
        let mut stages: VecDeque<Stage> = VecDeque::new();
        for how in [How::Names, How::Register] {
            // Those that have been asked in this way are not asked so again.
            let of_line = |stage: &&Stage| stage.line == line && stage.how == how;
            let units: VecDeque<u8> =
                self.stages.iter().filter(of_line).flat_map(|stage| &stage.units).copied().collect();
            stages.push_back(Stage { line, how, units });
        }
        // The stage under way stays the first.
        if here == Some(How::Register) {
            stages.swap(0, 1);
        }
        self.stages = stages;
        if let Some(line) = line.filter(|_| self.wanted.lines.len() > 1) {
            self.news.push_back(format!("the line has {line}; all units are asked there"));
        }
    }

    fn told(&mut self, reply: &Reply) {
        let Some((unit, mut interview)) = self.interview.take() else { return };
        let is_damaged = matches!(
            reply.result,
            Err(RequestError::Checksum | RequestError::WrongFrame | RequestError::Collision)
        );
        if is_damaged {
            *self.damaged.entry(unit).or_default() += 1;
            if self.repeated < LOOKS_AGAIN {
                self.repeated += 1;
                self.interview = Some((unit, interview));
                return;
            }
        }
        self.repeated = 0;
        interview.answered(&reply.result);
        if interview.question().is_some() {
            self.interview = Some((unit, interview));
        } else if interview.was_heard() {
            let found = Found { interview, damaged: self.damaged.get(&unit).copied().unwrap_or_default() };
            self.news.push_back(found.told(unit));
            self.found.insert(unit, found);
        } else if self.met.get(&unit).is_none_or(|met| *met <= LOOKS_AGAIN) {
            // It has answered, and then no more.
            self.look_again(unit, LOOKS_AGAIN);
        } else {
            self.give_up(unit, interview.silence().clone());
        }
    }

    fn give_up(&mut self, unit: u8, what: RequestError) {
        let garbled = Garbled { line: self.line(), unit, what };
        self.news.push_back(garbled.told());
        self.garbled.push(garbled);
    }

    /// The link does not open for `question`; `opens_as_before`: it does with the settings that it had before.
    /// `Err`: the scan cannot go on.
    pub fn not_opened(
        &mut self,
        question: &Question,
        why: String,
        opens_as_before: bool,
    ) -> Result<(), String> {
        // Where it still opens as before, it is these settings that the port does not take.
        match question.line.filter(|_| opens_as_before) {
            Some(line) => self.refuse_line(line, &why),
            None => return Err(why),
        }
        Ok(())
    }

    fn refuse_line(&mut self, line: Line, reason: &str) {
        self.stages.retain(|stage| stage.line != Some(line));
        self.again.clear();
        self.recent.clear();
        self.asked = None;
        self.news.push_back(format!("{line} is left out: {reason}"));
    }

    /// The link has ended, and `question` with it. `Err`: the scan cannot go on.
    pub fn lost(&mut self, question: Question, why: String) -> Result<(), String> {
        if !self.wanted.of_server {
            return Err(why);
        }
        // Many servers close a connection behind each answer, or one that was idle; the next one is as good.
        if std::mem::take(&mut self.has_asked_here) {
            self.once_more = Some(question);
            return Ok(());
        }
        // One that was made for this question: so a gateway may tell that the unit is not there.
        if self.hung_up == 0 {
            self.news.push_back(format!(
                "the other side ends the connection when unit {} is asked; that counts as silence",
                question.request.unit
            ));
        }
        self.hung_up += 1;
        let result = Err(RequestError::Link(why));
        self.answered(&Reply::new(result, Time::default(), None, &mut Discarded::default()));
        self.has_asked_here = false;
        Ok(())
    }

    /// What is worth a line, as it happens.
    pub fn next_news(&mut self) -> Option<String> {
        self.news.pop_front()
    }

    pub fn progress(&self) -> Progress {
        Progress { line: self.line(), unit: self.unit, questions: self.questions, at_most: self.at_most() }
    }

    /// With how many settings it begins.
    pub fn settings(&self) -> usize {
        self.wanted.lines.len()
    }

    /// How many units are asked.
    pub fn units(&self) -> usize {
        self.wanted.units.len()
    }

    /// How long the rest takes if nobody answers any more.
    pub fn at_most(&self) -> Duration {
        let of_stage = |stage: &Stage| {
            let units = stage.units.iter().filter(|unit| !self.is_known(stage.line, **unit)).count();
            self.cost(stage.line) * units as u32
        };
        self.stages.iter().map(of_stage).sum()
    }

    /// How long it takes if somebody answers with the first settings.
    pub fn at_best(&self) -> Duration {
        let line = self.line();
        self.cost(line) * (self.wanted.units.len() as u32 * 2)
    }

    fn cost(&self, line: Option<Line>) -> Duration {
        let on_the_wire = line.map_or(Duration::ZERO, |line| line.characters(REQUEST_CHARACTERS));
        on_the_wire + self.short_timeout(line)
    }

    /// What has been found; `is_whole`: nothing was left to be asked.
    pub fn report(self, is_whole: bool) -> Report {
        Report::new(self, is_whole)
    }
}

impl How {
    fn call(self) -> Call {
        match self {
            How::Names => Call::ReadIdentification { code: 1, object: 0 },
            How::Register => Call::Read(ANY_REGISTER),
        }
    }
}

#[cfg(test)]
mod tests;
