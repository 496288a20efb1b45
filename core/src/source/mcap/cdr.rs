//! CDR, the packing of ROS 2's messages (OMG DDS-XTYPES, plain CDR version 1): numbers aligned to their own size.

/// A value ran past the message's end, or the packing is another one.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct BadCdr(pub &'static str);

/// Reads one message from its start.
pub(super) struct Cdr<'a> {
    /// Without the four bytes that say how it is packed; alignment counts from here.
    body: &'a [u8],
    at: usize,
    little_endian: bool,
}

type Read<T> = Result<T, BadCdr>;

impl<'a> Cdr<'a> {
    pub(super) fn new(message: &'a [u8]) -> Read<Cdr<'a>> {
        let (head, body) = message.split_at_checked(4).ok_or(BadCdr("a message without its head"))?;
        match head[..2] {
            [0, 0] => Ok(Cdr { body, at: 0, little_endian: false }),
            [0, 1] => Ok(Cdr { body, at: 0, little_endian: true }),
            _ => Err(BadCdr("a packing other than plain CDR")),
        }
    }

    fn take(&mut self, bytes: usize) -> Read<&'a [u8]> {
        let taken = self.at.checked_add(bytes).and_then(|end| self.body.get(self.at..end));
        let taken = taken.ok_or(BadCdr("a message that ends too early"))?;
        self.at += bytes;
        Ok(taken)
    }

    fn number<const N: usize>(&mut self) -> Read<[u8; N]> {
        self.at = self.at.next_multiple_of(N);
        let mut bytes = [0; N];
        bytes.copy_from_slice(self.take(N)?);
        if !self.little_endian {
            bytes.reverse();
        }
        Ok(bytes)
    }

    pub(super) fn u8(&mut self) -> Read<u8> {
        Ok(self.take(1)?[0])
    }

    pub(super) fn u32(&mut self) -> Read<u32> {
        self.number().map(u32::from_le_bytes)
    }

    pub(super) fn i32(&mut self) -> Read<i32> {
        self.number().map(i32::from_le_bytes)
    }

    pub(super) fn f64(&mut self) -> Read<f64> {
        self.number().map(f64::from_le_bytes)
    }

    pub(super) fn f64s<const N: usize>(&mut self) -> Read<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    /// A string, without its closing zero.
    pub(super) fn text(&mut self) -> Read<String> {
        let bytes = self.bytes()?;
        Ok(String::from_utf8_lossy(bytes.strip_suffix(&[0]).unwrap_or(bytes)).into_owned())
    }

    /// A sequence of bytes.
    pub(super) fn bytes(&mut self) -> Read<&'a [u8]> {
        let count = self.u32()? as usize;
        self.take(count)
    }

    /// `builtin_interfaces/Time` as ns since the epoch; `None` where it is zero or before it.
    pub(super) fn time_ns(&mut self) -> Read<Option<u64>> {
        let (seconds, nanoseconds) = (self.i32()?, self.u32()?);
        let time_ns = u64::try_from(seconds).ok().map(|s| s * 1_000_000_000 + u64::from(nanoseconds));
        Ok(time_ns.filter(|ns| *ns > 0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_aligned_to_their_size_in_both_orders() {
        let little = [0, 1, 0, 0, 7, 0, 0, 0, 3, 0, 0, 0, b'a', b'b', 0, 9, 0, 0, 0, 0, 0, 0, 240, 63];
        let mut cdr = Cdr::new(&little).expect("plain");
        assert_eq!((cdr.u8(), cdr.text(), cdr.u8()), (Ok(7), Ok("ab".into()), Ok(9)));
        // Eleven bytes so far and one of nine: a double begins at 16 ... of which only 8 to 16 are left here.
        assert_eq!(cdr.f64(), Err(BadCdr("a message that ends too early")));
        let big = [0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 2];
        let mut cdr = Cdr::new(&big).expect("plain");
        assert_eq!((cdr.i32(), cdr.u32()), (Ok(1), Ok(2)));
    }

    #[test]
    fn lengths_that_cannot_be_are_refused() {
        let mut cdr = Cdr::new(&[0, 1, 0, 0, 255, 255, 255, 255, 1]).expect("plain");
        assert!(cdr.bytes().is_err());
        assert!(Cdr::new(&[0, 1]).is_err());
        assert!(Cdr::new(&[0, 3, 0, 0, 1]).is_err(), "parameter lists are another packing");
    }
}
