//! The ten operating modes of a channel, and what each of them has (page 25).

/// OperMode, registers 2 and 3.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    DirectControl = 0,
    MotorizedSafetyOpen = 1,
    MotorizedSafetyClose = 2,
    LimitSwitchOpenClose = 3,
    LimitSwitchOpen = 4,
    LimitSwitchClose = 5,
    FireDamper = 6,
    MotorSafetyOpen2 = 7,
    MotorSafetyClose2 = 8,
    InputLogicControl = 9,
}

/// Where a damper stands, or is to go: ActuPos and ActuDrive (page 27).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Position {
    Open = 1,
    Close = 2,
    Running = 3,
}

/// What the four modes for a damper with a motor differ in (pages 30 to 34).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Motor {
    /// Where the damper is safe: open lets smoke out, closed keeps fire in.
    pub safe: Position,
    /// "Motorized...": that the damper is where ActuDrive has sent it is an alarm, too, where that is
    /// the safe position. "Motor_..._2": it is none.
    pub drive_alarms: bool,
}

impl Mode {
    pub const ALL: [Mode; 10] = [
        Mode::DirectControl,
        Mode::MotorizedSafetyOpen,
        Mode::MotorizedSafetyClose,
        Mode::LimitSwitchOpenClose,
        Mode::LimitSwitchOpen,
        Mode::LimitSwitchClose,
        Mode::FireDamper,
        Mode::MotorSafetyOpen2,
        Mode::MotorSafetyClose2,
        Mode::InputLogicControl,
    ];

    pub fn from_word(word: u16) -> Option<Mode> {
        Mode::ALL.get(usize::from(word)).copied()
    }

    /// Whether this is one of the "Betriebsarten für Brandschutz-Klappen", which read and update their
    /// registers every 100 ms (page 21) and keep the channel's inputs for themselves (page 23).
    pub fn is_for_dampers(self) -> bool {
        !matches!(self, Mode::DirectControl | Mode::InputLogicControl)
    }

    /// Whether the mode reports by ActuPos and AlarmCode: Motorized, Motor and LimitSwitch (page 27).
    /// These have no hand switches (page 22); Fire_Damper has, and reports by bits.
    pub fn has_alarm_code(self) -> bool {
        self.is_for_dampers() && self != Mode::FireDamper
    }

    pub fn motor(self) -> Option<Motor> {
        match self {
            Mode::MotorizedSafetyOpen => Some(Motor { safe: Position::Open, drive_alarms: true }),
            Mode::MotorizedSafetyClose => Some(Motor { safe: Position::Close, drive_alarms: true }),
            Mode::MotorSafetyOpen2 => Some(Motor { safe: Position::Open, drive_alarms: false }),
            Mode::MotorSafetyClose2 => Some(Motor { safe: Position::Close, drive_alarms: false }),
            _ => None,
        }
    }

    /// Whether the relay is switched by the bus (pages 25 and 26). In the other modes the state tables,
    /// the inputs or nothing switch it, and what the bus writes to it has no function.
    pub fn obeys_bus(self) -> bool {
        matches!(self, Mode::DirectControl | Mode::FireDamper)
    }

    /// Whether the relay begins with RelayDefault (page 23).
    pub fn begins_with_default(self) -> bool {
        self.obeys_bus() || self == Mode::InputLogicControl
    }
}

impl Position {
    /// What the contacts AUF and ZU of one damper say. Both at once is "running", too: "In ActuPos_1…2
    /// wird gleichzeitig der Wert running gemeldet" (page 31).
    pub fn of_limit_switches(contacts: [bool; 2]) -> Position {
        match contacts {
            [true, false] => Position::Open,
            [false, true] => Position::Close,
            _ => Position::Running,
        }
    }

    /// What the only contact of a damper says: closed is open, and half open is what it was (page 30).
    pub fn of_single_switch(closed: bool) -> Position {
        if closed { Position::Open } else { Position::Close }
    }

    /// A word for ActuDrive.
    pub fn from_drive(word: u16) -> Option<Position> {
        [Position::Open, Position::Close].into_iter().find(|position| *position as u16 == word)
    }
}

impl Motor {
    /// The position of every day, which ActuDrive has after a start: the other one.
    pub fn normal(self) -> Position {
        if self.safe == Position::Open { Position::Close } else { Position::Open }
    }
}
