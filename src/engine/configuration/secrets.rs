//! A configuration's text without its passwords and tokens, for the lines that messages show.

/// `text` with a `*` for each byte of a password, so that every place stays where it is. Works on the
/// text and not on what it means: a password may be the very thing that makes it unreadable.
pub fn hidden(text: &str) -> String {
    text.split_inclusive('\n').map(hidden_in_line).collect()
}

fn hidden_in_line(line: &str) -> String {
    let mut hidden = line.as_bytes().to_vec();
    // `password: …` and `token: …`, also misspelt, but not `password_file: …`.
    for (at, _) in line.match_indices("pas").chain(line.match_indices("tok")) {
        let word_end =
            line[at..].find(|c: char| !c.is_ascii_alphanumeric()).map_or(line.len(), |end| at + end);
        let after = line[word_end..].trim_start_matches(['"', '\'', ' ']);
        if let Some(value) = after.strip_prefix(':') {
            stars(&mut hidden[line.len() - value.len()..]);
        }
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
            ("serial: /dev/serial/by-id/usb@1\n", "serial: /dev/serial/by-id/usb@1\n"),
        ] {
            assert_eq!(hidden(text), shown);
            assert_eq!(shown.len(), text.len(), "{text}");
        }
    }
}
