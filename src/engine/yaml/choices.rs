//! What can stand in the place of a wrong word.

/// The remedy for a wrong word: the one that was probably meant, or all that can stand here.
pub fn list_of_choices(found: &str, choices: &[&str]) -> String {
    if let Some(meant) = nearest(found, choices) {
        return format!("did you mean `{meant}`?");
    }
    let quoted: Vec<String> = choices.iter().map(|choice| format!("`{choice}`")).collect();
    match quoted.split_last() {
        None => "nothing can stand here".into(),
        Some((only, [])) => format!("expected {only}"),
        Some((last, others)) => format!("expected {} or {last}", others.join(", ")),
    }
}

/// The choice that differs from `found` by a slip of the fingers: one letter in three at most. Of several as
/// near as each other the one that looks most like it.
pub fn nearest<'a>(found: &str, choices: &[&'a str]) -> Option<&'a str> {
    let allowed = found.chars().count().max(2) / 3 + usize::from(found.chars().count() == 2);
    let is_far = |choice: &str| found.len().abs_diff(choice.len()) > 4 * allowed;
    choices
        .iter()
        .filter(|choice| !is_far(choice))
        .map(|choice| (distance(found, choice), *choice))
        .filter(|(distance, _)| *distance <= allowed)
        .min_by_key(|(apart, choice)| (*apart, distance(&as_seen(found), &as_seen(choice))))
        .map(|(_, choice)| choice)
}

/// With one letter for all that are read as each other on a label or a screen.
fn as_seen(word: &str) -> String {
    let seen = |letter: char| match letter.to_ascii_lowercase() {
        '0' => 'o',
        '1' | 'l' => 'i',
        '5' => 's',
        '8' => 'b',
        '_' => '-',
        other => other,
    };
    word.chars().map(seen).collect()
}

/// Letters to add, drop or change, and neighbours to swap, until `a` is `b`.
fn distance(a: &str, b: &str) -> usize {
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().collect(), b.chars().collect());
    let mut rows = vec![vec![0; b.len() + 1]; a.len() + 1];
    for (i, row) in rows.iter_mut().enumerate() {
        row[0] = i;
    }
    rows[0] = (0..=b.len()).collect();
    for i in 1..=a.len() {
        for j in 1..=b.len() {
            let changed = usize::from(a[i - 1] != b[j - 1]);
            let mut best = (rows[i - 1][j] + 1).min(rows[i][j - 1] + 1).min(rows[i - 1][j - 1] + changed);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                best = best.min(rows[i - 2][j - 2] + 1);
            }
            rows[i][j] = best;
        }
    }
    rows[a.len()][b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn check(found: &str, choices: &[&str], expected: Option<&str>) {
        assert_eq!(nearest(found, choices), expected, "{found}");
        let backwards: Vec<&str> = choices.iter().rev().copied().collect();
        assert_eq!(nearest(found, &backwards), expected, "{found}, in another order");
    }

    #[test]
    fn the_nearest_word_is_a_slip_of_the_fingers_away() {
        check("holdng", &["holding", "input"], Some("holding"));
        check("hodling", &["holding", "input"], Some("holding"));
        check("io", &["ip", "unit"], Some("ip"));
        check("flow", &["temperature", "level"], None);
        check("x", &["y"], None);
    }

    #[test]
    fn of_words_as_near_as_each_other_the_one_that_looks_like_it_is_meant() {
        let models = ["metz-connect/mr-di4", "metz-connect/mr-do4", "metz-connect/mr-ao4"];
        check("metz-connect/mr-d04", &models, Some("metz-connect/mr-do4"));
        check("metz-connect/mr-dl4", &models, Some("metz-connect/mr-di4"));
        check("metz-connect/mr-d14", &models, Some("metz-connect/mr-di4"));
        check("relay_B", &["relay_7", "relay_8"], Some("relay_8"));
        // Fewer letters count for more than likeness.
        check("line-1", &["line-l-1", "line-2"], Some("line-2"));
    }
}
