//! The PID controller of MR-AIO4/2, line by line as pages 72 and 73 give it.

use crate::simulator::metz_connect::channel::float;

/// What a controller is set to.
#[derive(Clone, Copy, Debug)]
pub struct Parameters {
    /// The flags of the mode register.
    pub mode: u16,
    /// Fp or Xp, by the flag `PROP_F`.
    pub fp_xp: f32,
    pub ti: f32,
    pub td: f32,
    pub t1: f32,
    /// The table of page 73 calls Ymin "Obergrenze" and Ymax "Untergrenze"; the algorithm on the page
    /// before, and the names, say the opposite.
    pub y_min: f32,
    pub y_max: f32,
    pub dead_range: f32,
    pub inactive_y: f32,
    pub initial_y: f32,
}

/// A controller between two steps.
#[derive(Clone, Copy, Debug, Default)]
pub struct Controller {
    pub yp: f32,
    /// Yi, and for the next step Yi_1.
    pub yi: f32,
    /// Ydt, and for the next step Ydt_1.
    pub ydt: f32,
    /// ManY.
    pub manual_y: f32,
    pub y: f32,
    /// Yq_1. There is none in the first step: a difference to nothing would not begin with InitY.
    yq_before: Option<f32>,
    was_enabled: bool,
    was_manual: bool,
}

/// The limit that changes during operation.
#[derive(Clone, Copy, Debug)]
pub enum Limit {
    /// Amin, of PID1.
    AtLeast(f32),
    /// Bmax, of PID2.
    AtMost(f32),
}

// The flags of registers 101 and 151.
pub const ENABLE: u16 = 1 << 0;
pub const PROP_F: u16 = 1 << 1;
pub const ACTION: u16 = 1 << 2;
pub const INPUT_D: u16 = 1 << 3;
/// EnAmin or EnBmax.
pub const EN_LIMIT: u16 = 1 << 4;
pub const MANUAL: u16 = 1 << 5;

/// Te in seconds. No page says it; an input has a new value "im Abstand von etwa 1 Sekunde" (page 62),
/// and to calculate more often would only stretch or sharpen what has not been measured.
pub const TE: f32 = 1.0;

impl Parameters {
    /// From the registers from 100 or 150 on.
    pub fn read(registers: &[u16; 24]) -> Parameters {
        let number = |at: usize| float([registers[at], registers[at + 1]]);
        Parameters {
            mode: registers[1],
            fp_xp: number(2),
            ti: number(4),
            td: number(6),
            t1: number(8),
            y_min: number(10),
            y_max: number(12),
            dead_range: number(14),
            inactive_y: number(16),
            initial_y: number(18),
        }
    }
}

impl Controller {
    /// Calculates once. The order, and what overrides what, are the page's; numbers that are none, as a
    /// range Xp of 0 gives, go through it as they would in the device.
    pub fn step(&mut self, parameters: &Parameters, x: f32, w: f32, limit: Limit) {
        let p = parameters;
        let is = |flag: u16| p.mode & flag != 0;
        let (enable, manual) = (is(ENABLE), is(MANUAL));
        let sign = if is(ACTION) { -1.0 } else { 1.0 };
        let fp = if is(PROP_F) { (p.y_max - p.y_min) / p.fp_xp } else { p.fp_xp };

        let xw = x - w;
        let yp = sign * fp * xw;
        let yq = sign * fp * if is(INPUT_D) { x } else { xw };

        let mut yi = self.yi;
        if enable && !self.was_enabled {
            yi = p.initial_y - yp;
        }
        if !manual && self.was_manual {
            yi = self.manual_y - yp;
        }
        if p.ti > 0.0 {
            yi += yp * TE / p.ti;
        }
        yi = limited(yi, p.y_min, p.y_max);
        if !enable || manual {
            yi = 0.0;
        }

        let yd = if p.td > 0.0 { (yq - self.yq_before.unwrap_or(yq)) * p.td / TE } else { 0.0 };
        let mut ydt = if p.t1 > 0.0 { self.ydt + (yd - self.ydt) * TE / p.t1 } else { yd };
        if !enable || manual {
            ydt = 0.0;
        }

        let mut ys = limited(yp + yi + ydt, p.y_min, p.y_max);
        if is(EN_LIMIT) {
            ys = match limit {
                Limit::AtLeast(least) if ys < least => least,
                Limit::AtMost(most) if ys > most => most,
                _ => ys,
            };
        }
        if manual {
            ys = self.manual_y;
        }
        if !enable {
            ys = p.inactive_y;
        }
        if !manual {
            self.manual_y = ys;
        }
        if (self.y - ys).abs() > p.dead_range {
            self.y = ys;
        }

        (self.yp, self.yi, self.ydt, self.yq_before) = (yp, yi, ydt, Some(yq));
        (self.was_enabled, self.was_manual) = (enable, manual);
    }
}

/// The lower limit first, as the page has it: where the limits are crossed, the upper one wins.
pub fn limited(value: f32, low: f32, high: f32) -> f32 {
    let value = if value < low { low } else { value };
    if value > high { high } else { value }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fp = 2 and nothing else: no integral, no derivative, 0 to 100 %, InitY = 50 %, DeactY = 7 %.
    const PROPORTIONAL: Parameters = Parameters {
        mode: ENABLE,
        fp_xp: 2.0,
        ti: 0.0,
        td: 0.0,
        t1: 0.0,
        y_min: 0.0,
        y_max: 100.0,
        dead_range: 0.0,
        inactive_y: 7.0,
        initial_y: 50.0,
    };
    const NO_LIMIT: Limit = Limit::AtLeast(0.0);

    /// Steps a fresh controller through X and W, and compares Yp, Yi, Ydt and Y after each.
    #[track_caller]
    fn check(parameters: Parameters, limit: Limit, rows: &[(f32, f32, [f32; 4])]) {
        let rows: Vec<_> = rows.iter().map(|(x, w, wanted)| (parameters.mode, *x, *w, *wanted)).collect();
        check_modes(parameters, limit, &rows);
    }

    /// The same with the mode before each step.
    #[track_caller]
    fn check_modes(parameters: Parameters, limit: Limit, rows: &[(u16, f32, f32, [f32; 4])]) {
        let mut controller = Controller::default();
        for (number, (mode, x, w, wanted)) in rows.iter().enumerate() {
            controller.step(&Parameters { mode: *mode, ..parameters }, *x, *w, limit);
            let Controller { yp, yi, ydt, y, .. } = controller;
            assert_eq!([yp, yi, ydt, y], *wanted, "step {number}");
        }
    }

    #[test]
    fn the_proportional_part_is_xw_times_fp_or_the_range_divided_by_xp_page_72() {
        let rows = [
            (30.0, 20.0, [20.0, 30.0, 0.0, 50.0]),
            (35.0, 20.0, [30.0, 30.0, 0.0, 60.0]),
            (10.0, 20.0, [-20.0, 30.0, 0.0, 10.0]),
            // Ymin and Ymax.
            (0.0, 20.0, [-40.0, 30.0, 0.0, 0.0]),
            (90.0, 20.0, [140.0, 30.0, 0.0, 100.0]),
        ];
        check(PROPORTIONAL, NO_LIMIT, &rows);
        check(Parameters { mode: ENABLE | PROP_F, fp_xp: 50.0, ..PROPORTIONAL }, NO_LIMIT, &rows);
        // Ymax - Ymin counts, not Ymax alone.
        let shifted =
            Parameters { mode: ENABLE | PROP_F, fp_xp: 25.0, y_min: 10.0, y_max: 60.0, ..PROPORTIONAL };
        check(shifted, NO_LIMIT, &[(25.0, 20.0, [10.0, 40.0, 0.0, 50.0])]);
    }

    #[test]
    fn action_negates_the_difference_and_what_is_differentiated_page_72() {
        let parameters = Parameters { mode: ENABLE | ACTION, td: 3.0, ..PROPORTIONAL };
        check(
            parameters,
            NO_LIMIT,
            &[(15.0, 20.0, [10.0, 40.0, 0.0, 50.0]), (14.0, 20.0, [12.0, 40.0, 6.0, 58.0])],
        );
        let parameters = Parameters { mode: ENABLE | ACTION | INPUT_D, td: 3.0, ..PROPORTIONAL };
        check(
            parameters,
            NO_LIMIT,
            &[(15.0, 20.0, [10.0, 40.0, 0.0, 50.0]), (14.0, 20.0, [12.0, 40.0, 6.0, 58.0])],
        );
    }

    #[test]
    fn the_integral_part_grows_by_yp_te_ti_and_stays_between_ymin_and_ymax_page_72() {
        let parameters = Parameters { ti: 4.0, ..PROPORTIONAL };
        check(
            parameters,
            NO_LIMIT,
            &[
                (30.0, 20.0, [20.0, 35.0, 0.0, 55.0]),
                (30.0, 20.0, [20.0, 40.0, 0.0, 60.0]),
                (20.0, 20.0, [0.0, 40.0, 0.0, 40.0]),
                (140.0, 20.0, [240.0, 100.0, 0.0, 100.0]),
                (140.0, 20.0, [240.0, 100.0, 0.0, 100.0]),
                // Nothing has been wound up beyond Ymax.
                (10.0, 20.0, [-20.0, 95.0, 0.0, 75.0]),
                (-180.0, 20.0, [-400.0, 0.0, 0.0, 0.0]),
                (30.0, 20.0, [20.0, 5.0, 0.0, 25.0]),
            ],
        );
    }

    #[test]
    fn the_derivative_part_is_filtered_by_t1_alone_page_72() {
        check(
            Parameters { td: 3.0, ..PROPORTIONAL },
            NO_LIMIT,
            &[
                (30.0, 20.0, [20.0, 30.0, 0.0, 50.0]),
                (31.0, 20.0, [22.0, 30.0, 6.0, 58.0]),
                (31.0, 20.0, [22.0, 30.0, 0.0, 52.0]),
                (30.0, 20.0, [20.0, 30.0, -6.0, 44.0]),
            ],
        );
        check(
            Parameters { td: 3.0, t1: 4.0, ..PROPORTIONAL },
            NO_LIMIT,
            &[
                (30.0, 20.0, [20.0, 30.0, 0.0, 50.0]),
                (31.0, 20.0, [22.0, 30.0, 1.5, 53.5]),
                (32.0, 20.0, [24.0, 30.0, 2.625, 56.625]),
                (32.0, 20.0, [24.0, 30.0, 1.96875, 55.96875]),
            ],
        );
        // T1 without Td is nothing.
        let filter_alone = Parameters { t1: 4.0, ..PROPORTIONAL };
        let rows = [(30.0, 20.0, [20.0, 30.0, 0.0, 50.0]), (31.0, 20.0, [22.0, 30.0, 0.0, 52.0])];
        check(filter_alone, NO_LIMIT, &rows);
    }

    #[test]
    fn input_d_keeps_a_new_set_point_out_of_the_derivative_part_page_69() {
        let with = |mode: u16| Parameters { mode, td: 3.0, ..PROPORTIONAL };
        let start = (30.0, 20.0, [20.0, 30.0, 0.0, 50.0]);
        check(with(ENABLE), NO_LIMIT, &[start, (30.0, 18.0, [24.0, 30.0, 12.0, 66.0])]);
        check(with(ENABLE | INPUT_D), NO_LIMIT, &[start, (30.0, 18.0, [24.0, 30.0, 0.0, 54.0])]);
        // A new measured value is in it all the same.
        check(with(ENABLE | INPUT_D), NO_LIMIT, &[start, (31.0, 20.0, [22.0, 30.0, 6.0, 58.0])]);
    }

    #[test]
    fn amin_and_bmax_limit_only_where_they_are_released_and_beyond_ymin_and_ymax_page_72() {
        for (mode, limit, y) in [
            (ENABLE, Limit::AtLeast(70.0), 50.0),
            (ENABLE | EN_LIMIT, Limit::AtLeast(70.0), 70.0),
            (ENABLE | EN_LIMIT, Limit::AtLeast(30.0), 50.0),
            (ENABLE | EN_LIMIT, Limit::AtLeast(130.0), 130.0),
            (ENABLE, Limit::AtMost(30.0), 50.0),
            (ENABLE | EN_LIMIT, Limit::AtMost(30.0), 30.0),
            (ENABLE | EN_LIMIT, Limit::AtMost(70.0), 50.0),
            (ENABLE | EN_LIMIT, Limit::AtMost(-5.0), -5.0),
            // What is set by hand, or for an inactive controller, is not limited.
            (ENABLE | EN_LIMIT | MANUAL, Limit::AtLeast(70.0), 0.0),
            (EN_LIMIT, Limit::AtLeast(70.0), 7.0),
        ] {
            let mut controller = Controller::default();
            controller.step(&Parameters { mode, ..PROPORTIONAL }, 30.0, 20.0, limit);
            assert_eq!(controller.y, y, "{mode:b} {limit:?}");
        }
    }

    #[test]
    fn y_changes_only_by_more_than_the_dead_range_page_70() {
        check(
            Parameters { dead_range: 2.0, ..PROPORTIONAL },
            NO_LIMIT,
            &[
                (30.0, 20.0, [20.0, 30.0, 0.0, 50.0]),
                (31.0, 20.0, [22.0, 30.0, 0.0, 50.0]),
                (31.5, 20.0, [23.0, 30.0, 0.0, 53.0]),
                (30.5, 20.0, [21.0, 30.0, 0.0, 53.0]),
                (30.0, 20.0, [20.0, 30.0, 0.0, 50.0]),
            ],
        );
    }

    #[test]
    fn by_hand_the_controller_stays_where_it_was_and_goes_on_from_there_page_70() {
        let parameters = Parameters { ti: 4.0, td: 3.0, ..PROPORTIONAL };
        let mut controller = Controller::default();
        let step = |controller: &mut Controller, mode: u16, x: f32| {
            controller.step(&Parameters { mode, ..parameters }, x, 20.0, NO_LIMIT);
            [controller.yp, controller.yi, controller.ydt, controller.y]
        };
        assert_eq!(step(&mut controller, ENABLE, 30.0), [20.0, 35.0, 0.0, 55.0]);
        assert_eq!(controller.manual_y, 55.0);
        assert_eq!(step(&mut controller, ENABLE | MANUAL, 40.0), [40.0, 0.0, 0.0, 55.0]);
        controller.manual_y = 64.0;
        assert_eq!(step(&mut controller, ENABLE | MANUAL, 30.0), [20.0, 0.0, 0.0, 64.0]);
        // Yi = ManY - Yp, and then the step's own part of it.
        assert_eq!(step(&mut controller, ENABLE, 30.0), [20.0, 49.0, 0.0, 69.0]);
        assert_eq!(controller.manual_y, 69.0);
    }

    #[test]
    fn an_inactive_controller_gives_deact_y_and_an_activated_one_begins_with_init_y_page_70() {
        check_modes(
            PROPORTIONAL,
            NO_LIMIT,
            &[
                (ENABLE, 30.0, 20.0, [20.0, 30.0, 0.0, 50.0]),
                (0, 30.0, 20.0, [20.0, 0.0, 0.0, 7.0]),
                // Inactive is stronger than by hand.
                (MANUAL, 30.0, 20.0, [20.0, 0.0, 0.0, 7.0]),
                (0, 30.0, 20.0, [20.0, 0.0, 0.0, 7.0]),
                (ENABLE, 25.0, 20.0, [10.0, 40.0, 0.0, 50.0]),
                (ENABLE, 26.0, 20.0, [12.0, 40.0, 0.0, 52.0]),
            ],
        );
        // An InitY below Yp would need a negative Yi, which is limited to Ymin.
        let below = Parameters { initial_y: 10.0, ..PROPORTIONAL };
        check(below, NO_LIMIT, &[(30.0, 20.0, [20.0, 0.0, 0.0, 20.0])]);
    }
}
