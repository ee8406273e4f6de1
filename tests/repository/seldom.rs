//! Every line of `scripts/seldom.ld` names functions that there are: a module that is called otherwise, or a crate
//! that is used no more, would lie with all others again, and nobody would notice.

use std::process::Command;

#[test]
fn every_line_of_the_linker_script_names_functions_that_there_are() {
    let Ok(listed) = Command::new("nm").arg(env!("CARGO_BIN_EXE_busker")).output() else {
        eprintln!("no nm here: the linker script is not held against the program");
        return;
    };
    assert!(listed.status.success(), "{}", String::from_utf8_lossy(&listed.stderr));
    let listed = String::from_utf8(listed.stdout).expect("the names of functions are text");
    let functions: Vec<&str> = listed.lines().filter_map(|line| line.split_whitespace().last()).collect();
    let lines = lines();
    assert!(lines.len() > 40, "only {} lines were found", lines.len());
    let names_nothing = |line: &Vec<&str>| {
        // There are a hundred thousand functions: only those are looked at that bear the module's name at all.
        let path = line[0].split(['*', '[']).next().unwrap_or_default();
        let module = path.rsplit(|letter: char| letter.is_ascii_digit()).find(|name| !name.is_empty());
        let module = module.unwrap_or_else(|| panic!("`{path}` names no module"));
        let mut named = functions.iter().filter(|function| function.contains(module));
        !named.any(|function| line.iter().any(|pattern| fits(pattern, function)))
    };
    let nothing: Vec<&str> = lines.into_iter().filter(names_nothing).map(|line| line[0]).collect();
    assert!(nothing.is_empty(), "scripts/seldom.ld names functions that there are none of: {nothing:#?}");
}

#[test]
fn a_function_has_its_place_by_where_it_is_and_not_by_the_types_it_was_made_for() {
    let lines = lines();
    for (function, expected) in [
        ("_ZN12clap_builder5error9formatter17h8b10e5db7109edb1E", true),
        ("_RNvNtNtCs31Vt1FY2bU8_12clap_builder5error6format5start", true),
        ("_RNCNvMs2_NtNtNtCs2q09lrEK1C4_6busker3cli5check7feedingNtB5_6Delays2of0B9_", true),
        (
            "_RNvXs_NtNtCs2q09lrEK1C4_6busker3cli5checkNtB4_4ArgsNtNtCs31Vt1FY2bU8_12clap_builder6derive4Args5build",
            true,
        ),
        // The listener starts with the program; what it answers seldom runs.
        ("_RNvNtNtCs2q09lrEK1C4_6busker4edge4http6health", true),
        ("_RNvMNtNtCs2q09lrEK1C4_6busker4edge4httpNtB2_4Http4bind", false),
        ("_RNvNtNtCs2q09lrEK1C4_6busker6engine6reload7compare", true),
        ("_RNvNtNtCs2q09lrEK1C4_6busker6engine6reload17topics_of_devices", false),
        // Of the standard library, for a type of a module that is named.
        ("_RINvNtCskADBYZwJmSU_4core3ptr4dropNtNtCs31Vt1FY2bU8_12clap_builder5error5ErrorE", false),
        ("_RNvMs_NtNtCskADBYZwJmSU_4core3opsNtNtCs2q09lrEK1C4_6busker3cli5check4Args4call", false),
        ("_RNvNtCs2q09lrEK1C4_6busker4main", false),
    ] {
        let is_named = lines.iter().flatten().any(|pattern| fits(pattern, function));
        assert_eq!(is_named, expected, "{function}");
    }
}

/// What the script that was written for the linker names, with the names of older and of newer compilers.
fn lines() -> Vec<Vec<&'static str>> {
    let script = include_str!(concat!(env!("OUT_DIR"), "/seldom.ld"));
    let inside = script.lines().filter_map(|line| line.trim().strip_prefix("*(")?.strip_suffix(')'));
    let of_functions = inside.filter(|patterns| patterns.starts_with(".text."));
    let function = |pattern: &'static str| {
        let function = pattern.strip_prefix(".text.");
        function.unwrap_or_else(|| panic!("`{pattern}` is no section of a function"))
    };
    of_functions.map(|patterns| patterns.split(' ').map(function).collect()).collect()
}

/// Whether the linker takes `name` for one that `pattern` means: `*`, `?`, and `[!x]` for any letter but that.
fn fits(pattern: &str, name: &str) -> bool {
    let special = ['*', '?', '['];
    let (literal, rest) = pattern.split_at(pattern.find(special).unwrap_or(pattern.len()));
    let Some(name) = name.strip_prefix(literal) else { return false };
    if let Some(rest) = rest.strip_prefix('*') {
        let literal = rest.split(special).next().unwrap_or_default();
        return rest.is_empty() || name.match_indices(literal).any(|(at, _)| fits(rest, &name[at..]));
    }
    if let Some(rest) = rest.strip_prefix("[!") {
        let (unwanted, rest) = rest.split_once(']').expect("only `[!x]` is used");
        let mut letters = name.chars();
        return letters.next().is_some_and(|letter| !unwanted.contains(letter))
            && fits(rest, letters.as_str());
    }
    // All of them at once, for there are many.
    let behind = rest.trim_start_matches('?');
    let letters = rest.len() - behind.len();
    if letters == 0 { name.is_empty() } else { name.get(letters..).is_some_and(|name| fits(behind, name)) }
}

#[test]
fn a_pattern_is_understood_as_the_linker_does() {
    for (pattern, name, expected) in [
        ("_ZN5hyper*", "_ZN5hyper4body", true),
        ("_ZN5hyper*", "_ZN10hyper_util", false),
        ("_ZN*_$LT$hyper..*", "_ZN59_$LT$hyper..body", true),
        ("_ZN*_$LT$hyper..*", "_ZN59_$LT$hyper_util..body", false),
        ("reload[!1]*", "reload7compare", true),
        ("reload[!1]*", "reload17topics_of_devices", false),
        ("_5gimli?*", "_5gimli", false),
        ("_5gimli?*", "_5gimli4read", true),
        ("_R???_4http*", "_RNvC_4http3get", true),
        ("_R???_4http*", "_RNvNt_4http3get", false),
        ("_R???_4http*", "_RN", false),
        ("_R", "_RN", false),
        ("[!4N]*", "", false),
        ("[!4N]*", "Nt", false),
    ] {
        assert_eq!(fits(pattern, name), expected, "{pattern} {name}");
    }
}
