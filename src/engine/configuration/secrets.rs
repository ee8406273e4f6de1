//! A configuration's text without its passwords and tokens, for the lines that messages show.

/// `text` with a `*` for each byte of a password, so that every place stays where it is. Works on the
/// text and not on what it means: a password may be the very thing that makes it unreadable.
pub fn hidden(text: &str) -> String {
    let mut shown = String::new();
    // How far the key is indented whose value is a secret and stands in the lines behind it.
    let mut goes_on: Option<usize> = None;
    for line in text.split_inclusive('\n') {
        let text = line.trim_start_matches([' ', '\t']);
        let indent = line.len() - text.len();
        goes_on = goes_on.filter(|of_key| is_of_value(text.trim_end(), indent, *of_key));
        let from = goes_on.map_or_else(|| secret_in_line(line), |_| Some(indent));
        shown += &hidden_in_line(line, from);
        // The rest of a text in quotes or braces, or what `|` or nothing behind the key announces.
        goes_on = goes_on.or(from.map(|_| indent));
    }
    shown
}

/// Whether a line that may be of the value of a key in a line before it is not a new key.
fn is_of_value(text: &str, indent: usize, of_key: usize) -> bool {
    // The entries of a list may stand below its key itself.
    let is_entry = indent == of_key && (text == "-" || text.starts_with("- "));
    indent > of_key || is_entry || text.is_empty() || text.starts_with('#')
}

/// Where the value of a key that looks like a secret's begins.
fn secret_in_line(line: &str) -> Option<usize> {
    // `password: …` and `token: …`, also misspelt, but not `password_file: …`.
    let beginnings = ["pas", "tok", "secret", "pwd", "pw"];
    let keys = beginnings.iter().flat_map(|word| line.match_indices(word));
    let values = keys.filter_map(|(at, word)| {
        let end = line[at..].find(|c: char| !c.is_ascii_alphanumeric()).map_or(line.len(), |end| at + end);
        // A `pwm` is none.
        let is_one = word != "pw" || end == at + 2;
        let value = line[end..].trim_start_matches(['"', '\'', ' ']).strip_prefix(':')?;
        is_one.then_some(line.len() - value.len())
    });
    values.min()
}

fn hidden_in_line(line: &str, from: Option<usize>) -> String {
    let mut hidden = line.as_bytes().to_vec();
    if let Some(from) = from {
        stars(&mut hidden[from..]);
    }
    // `mqtt://user:password@host`; a password may hold an `@` itself.
    if let (Some(start), Some(end)) = (line.find("://"), line.rfind('@')) {
        if start + 3 < end {
            stars(&mut hidden[start + 3..end]);
        }
    } else if let Some(end) = line.rfind('@').filter(|_| line.contains("url")) {
        let start = line.find(':').map_or(0, |colon| colon + 1).min(end);
        stars(&mut hidden[start..end]);
    }
    // `wss://host/mqtt?token=…`
    if let Some(start) = line.find("://") {
        if let Some(query) = line[start..].find('?') {
            let end = line[start..].find([' ', '\'', '"']).map_or(line.len(), |end| start + end);
            stars(&mut hidden[start + query + 1..end.max(start + query + 1)]);
        }
    }
    String::from_utf8(hidden).unwrap_or_default()
}

fn stars(bytes: &mut [u8]) {
    let secret = bytes.iter_mut().filter(|byte| !byte.is_ascii_whitespace());
    secret.for_each(|byte| *byte = b'*');
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_password_is_hidden_and_nothing_moves() {
        for (text, shown) in [
            ("  password: s3cr et\n", "  password: **** **\n"),
            ("{username: u, 'password' : x, tls: 1}\n", "{username: u, 'password' : ** **** **\n"),
            // A star for each byte, of which the é has two.
            ("  pasword: gehéim\n", "  pasword: *******\n"),
            ("  password_file: /etc/x\n", "  password_file: /etc/x\n"),
            ("http: {token: abc, listen: 'h:1'}\n", "http: {token: **** ******* ******\n"),
            ("  tokken: abc\n", "  tokken: ***\n"),
            ("  token_file: /etc/x\n", "  token_file: /etc/x\n"),
            ("url: mqtt://joe:p@ss@host:1\n", "url: mqtt://********@host:1\n"),
            ("url: joe:pw@host\n", "url: ******@host\n"),
            ("url: mqtt://host:1\n", "url: mqtt://host:1\n"),
            ("url: 'wss://host/mqtt?token=x', a: b\n", "url: 'wss://host/mqtt?*******', a: b\n"),
            ("  pw: abc\n  secret: abc\n  pwm: 5\n", "  pw: ***\n  secret: ***\n  pwm: 5\n"),
            (
                "  password:\n    - s3cret\n\n    x: y\n  url: a\n",
                "  password:\n    * ******\n\n    ** *\n  url: a\n",
            ),
            ("  password:\n  - s3cret\n  url: a\n", "  password:\n  * ******\n  url: a\n"),
            ("  password: |\n# x\n    s3cret\nbuses:\n", "  password: *\n* *\n    ******\nbuses:\n"),
            ("  password: 'two\n    words'\nbuses:\n", "  password: ****\n    ******\nbuses:\n"),
            ("serial: /dev/serial/by-id/usb@1\n", "serial: /dev/serial/by-id/usb@1\n"),
        ] {
            assert_eq!(hidden(text), shown);
            assert_eq!(shown.len(), text.len(), "{text}");
        }
    }
}
