//! MCAP files as a row of records, read from start to end: what sources and exports share.
//!
//! Only the data section is read, never more than one record at a time, so a file needs no memory for its length and
//! may have been cut off anywhere: what it holds is given, and [`Records::damage`] says in words what is wrong with it.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::McapError;
use mcap::records::{Record as Raw, op};
use mcap::sans_io::{
    LinearReadEvent, LinearReader, LinearReaderOptions, SummaryReadEvent, SummaryReader, SummaryReaderOptions,
};

use crate::error::{Error, Result};

/// Largest message, attachment or other record that is read, bytes: a length beyond it is damage.
pub const MAX_RECORD_BYTES: usize = 256 << 20;
/// What every MCAP file begins with.
pub const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n'];

/// What a channel says of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct Topic {
    /// Its name, such as `/camera/image`.
    pub name: String,
    /// The name of its messages' schema, such as `foxglove.CompressedVideo`; empty where there is none.
    pub schema: String,
    /// How the schema is written down (`protobuf`, `ros2msg`, `jsonschema`).
    pub schema_encoding: String,
    /// The schema itself.
    pub schema_data: Arc<Vec<u8>>,
    /// How the messages are packed (`protobuf`, `cdr`, `json`).
    pub encoding: String,
    /// More about it.
    pub metadata: BTreeMap<String, String>,
}

/// A record of the data section.
#[derive(Clone, Debug, PartialEq)]
pub enum Record {
    /// A message of a wanted topic.
    Message(Message),
    /// A file inside the file.
    Attachment(Attachment),
    /// Named values.
    Metadata {
        /// What they are about.
        name: String,
        /// The values.
        values: BTreeMap<String, String>,
    },
}

/// A message with its topic.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// Where it belongs.
    pub topic: Arc<Topic>,
    /// When it was recorded, ns since the epoch.
    pub log_time_ns: u64,
    /// When it was published, ns since the epoch.
    pub publish_time_ns: u64,
    /// Its number among its channel's.
    pub sequence: u32,
    /// Its bytes, packed as the topic says.
    pub data: Vec<u8>,
}

/// A file inside the file.
#[derive(Clone, Debug, PartialEq)]
pub struct Attachment {
    /// Its name.
    pub name: String,
    /// Its media type.
    pub media_type: String,
    /// When it was attached, ns since the epoch.
    pub log_time_ns: u64,
    /// Its bytes.
    pub data: Vec<u8>,
}

/// Whether a file is an MCAP file, by its first bytes.
pub fn is_mcap(path: &Path) -> bool {
    let mut head = [0; MAGIC.len()];
    File::open(path).and_then(|mut file| file.read_exact(&mut head)).is_ok() && head == MAGIC
}

/// Reads files one after the other, from start to end.
pub struct Records {
    name: String,
    waiting: VecDeque<PathBuf>,
    file: Option<OpenFile>,
    damage: Option<String>,
}

struct OpenFile {
    path: PathBuf,
    file: BufReader<Box<dyn Read + Send>>,
    reader: LinearReader,
    /// Name, encoding and text of each.
    schemas: HashMap<u16, (String, String, Arc<Vec<u8>>)>,
    topics: HashMap<u16, Arc<Topic>>,
}

impl Records {
    /// Starts with the first of the files; `name` names them in messages.
    ///
    /// # Errors
    /// Where the first file cannot be read or is no MCAP file.
    pub fn open(paths: &[PathBuf], name: &str) -> Result<Records> {
        let mut waiting: VecDeque<PathBuf> = paths.to_vec().into();
        let first = waiting.pop_front().ok_or_else(|| Error::input(name, "no file", "an MCAP file"))?;
        if !is_mcap(&first) {
            return Err(Error::input(name, "no MCAP file (other first bytes)", "an MCAP file"));
        }
        Ok(Records { name: name.into(), waiting, file: Some(OpenFile::open(&first)?), damage: None })
    }

    /// Reads what comes from somewhere else than a file.
    pub fn of(reader: Box<dyn Read + Send>, name: &str) -> Records {
        let file = OpenFile::of(Path::new(name), reader);
        Records { name: name.into(), waiting: VecDeque::new(), file: Some(file), damage: None }
    }

    /// What is wrong with what was read so far, in words for people.
    pub fn damage(&self) -> Option<&str> {
        self.damage.as_deref()
    }

    /// The next record; messages only of the topics that `wanted` takes. `None` at the end of what can be read.
    ///
    /// # Errors
    /// What the disk says. A damaged file is no error: it ends there.
    pub fn next(&mut self, mut wanted: impl FnMut(&Topic) -> bool) -> Result<Option<Record>> {
        while let Some(file) = &mut self.file {
            match file.next(&mut wanted) {
                Ok(Some(record)) => return Ok(Some(record)),
                Ok(None) => self.file = self.waiting.pop_front().map(|path| OpenFile::open(&path)).transpose()?,
                Err(McapError::Io(e)) => return Err(Error::io(&file.path, e)),
                Err(error) => {
                    let what = match error {
                        McapError::UnexpectedEof => "it was cut off".to_string(),
                        other => format!("it is damaged ({other})"),
                    };
                    self.damage.get_or_insert_with(|| format!("{}: {what}; what it holds was read", self.name));
                    self.file = self.waiting.pop_front().map(|path| OpenFile::open(&path)).transpose()?;
                }
            }
        }
        Ok(None)
    }
}

impl OpenFile {
    fn open(path: &Path) -> Result<OpenFile> {
        let file = File::open(path).map_err(|e| Error::io(path, e))?;
        Ok(OpenFile::of(path, Box::new(file)))
    }

    fn of(path: &Path, file: Box<dyn Read + Send>) -> OpenFile {
        let options = LinearReaderOptions::default()
            .with_skip_end_magic(true)
            .with_validate_chunk_crcs(true)
            .with_record_length_limit(MAX_RECORD_BYTES);
        OpenFile {
            path: path.to_path_buf(),
            file: BufReader::with_capacity(1 << 20, file),
            reader: LinearReader::new_with_options(options),
            schemas: HashMap::new(),
            topics: HashMap::new(),
        }
    }

    fn next(&mut self, wanted: &mut impl FnMut(&Topic) -> bool) -> std::result::Result<Option<Record>, McapError> {
        loop {
            let Some(event) = self.reader.next_event() else { return Err(McapError::UnexpectedEof) };
            let (opcode, data) = match event? {
                LinearReadEvent::ReadRequest(bytes) => {
                    let read = self.file.read(self.reader.insert(bytes))?;
                    self.reader.notify_read(read);
                    continue;
                }
                LinearReadEvent::Record { opcode, data } => (opcode, data),
            };
            if opcode == op::DATA_END {
                return Ok(None);
            }
            match mcap::parse_record(opcode, data)? {
                Raw::Schema { header, data } => {
                    self.schemas.insert(header.id, (header.name, header.encoding, Arc::new(data.into_owned())));
                }
                Raw::Channel(channel) => {
                    let (schema, schema_encoding, schema_data) =
                        self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                    let topic = Topic {
                        name: channel.topic,
                        schema,
                        schema_encoding,
                        schema_data,
                        encoding: channel.message_encoding,
                        metadata: channel.metadata,
                    };
                    self.topics.insert(channel.id, Arc::new(topic));
                }
                Raw::Message { header, data } => {
                    // A message before its channel says nothing that could be understood.
                    let Some(topic) = self.topics.get(&header.channel_id).filter(|topic| wanted(topic)) else {
                        continue;
                    };
                    return Ok(Some(Record::Message(Message {
                        topic: topic.clone(),
                        log_time_ns: header.log_time,
                        publish_time_ns: header.publish_time,
                        sequence: header.sequence,
                        data: data.into_owned(),
                    })));
                }
                Raw::Attachment { header, data, .. } => {
                    return Ok(Some(Record::Attachment(Attachment {
                        name: header.name,
                        media_type: header.media_type,
                        log_time_ns: header.log_time,
                        data: data.into_owned(),
                    })));
                }
                Raw::Metadata(metadata) => {
                    return Ok(Some(Record::Metadata { name: metadata.name, values: metadata.metadata }));
                }
                _ => {}
            }
        }
    }
}

/// A topic and how much there is of it.
#[derive(Clone, Debug, PartialEq)]
pub struct TopicFacts {
    /// What it is.
    pub topic: Arc<Topic>,
    /// Its messages.
    pub messages: u64,
}

/// What files hold, without their messages.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Contents {
    /// Every topic, by name.
    pub topics: Vec<TopicFacts>,
    /// The names of the attachments, in the order of the file.
    pub attachments: Vec<String>,
    /// The first message's log time, ns since the epoch; 0 where there is none.
    pub start_ns: u64,
    /// The last message's log time, ns since the epoch; 0 where there is none.
    pub end_ns: u64,
    /// What is wrong with the files, in words.
    pub damage: Option<String>,
}

/// Says what files hold: from their own summaries, or, where one was cut off, by reading it through.
///
/// # Errors
/// Where a file cannot be read or is no MCAP file.
pub fn contents(paths: &[PathBuf], name: &str) -> Result<Contents> {
    let mut all = Contents { start_ns: u64::MAX, ..Contents::default() };
    for path in paths {
        if !is_mcap(path) {
            return Err(Error::input(name, "no MCAP file (other first bytes)", "an MCAP file"));
        }
        match summary(path)? {
            Some(summary) => all.add_summary(&summary),
            None => all.add_read_through(path, name)?,
        }
    }
    if all.start_ns == u64::MAX {
        all.start_ns = 0;
    }
    all.topics.sort_by(|a, b| a.topic.name.cmp(&b.topic.name));
    Ok(all)
}

impl Contents {
    fn add(&mut self, topic: &Arc<Topic>, messages: u64) {
        match self.topics.iter_mut().find(|known| known.topic == *topic) {
            Some(known) => known.messages += messages,
            None => self.topics.push(TopicFacts { topic: topic.clone(), messages }),
        }
    }

    fn add_times(&mut self, start_ns: u64, end_ns: u64) {
        self.start_ns = self.start_ns.min(start_ns);
        self.end_ns = self.end_ns.max(end_ns);
    }

    fn add_summary(&mut self, summary: &mcap::Summary) {
        let Some(statistics) = &summary.stats else { return };
        for channel in summary.channels.values() {
            let schema = channel.schema.as_deref();
            let topic = Topic {
                name: channel.topic.clone(),
                schema: schema.map(|s| s.name.clone()).unwrap_or_default(),
                schema_encoding: schema.map(|s| s.encoding.clone()).unwrap_or_default(),
                schema_data: Arc::new(schema.map(|s| s.data.to_vec()).unwrap_or_default()),
                encoding: channel.message_encoding.clone(),
                metadata: channel.metadata.clone(),
            };
            let messages = statistics.channel_message_counts.get(&channel.id).copied().unwrap_or(0);
            self.add(&Arc::new(topic), messages);
        }
        let mut attachments: Vec<_> = summary.attachment_indexes.iter().collect();
        attachments.sort_by_key(|index| index.offset);
        self.attachments.extend(attachments.into_iter().map(|index| index.name.clone()));
        if statistics.message_count > 0 {
            self.add_times(statistics.message_start_time, statistics.message_end_time);
        }
    }

    fn add_read_through(&mut self, path: &Path, name: &str) -> Result<()> {
        let mut records = Records::open(&[path.to_path_buf()], name)?;
        while let Some(record) = records.next(|_| true)? {
            match record {
                Record::Message(message) => {
                    self.add(&message.topic, 1);
                    self.add_times(message.log_time_ns, message.log_time_ns);
                }
                Record::Attachment(attachment) => self.attachments.push(attachment.name),
                Record::Metadata { .. } => {}
            }
        }
        self.damage = self.damage.take().or(records.damage().map(String::from));
        Ok(())
    }
}

/// The file's own table of contents; `None` where it has none, or was cut off before it.
fn summary(path: &Path) -> Result<Option<mcap::Summary>> {
    let mut file = BufReader::new(File::open(path).map_err(|e| Error::io(path, e))?);
    let bytes = file.get_ref().metadata().map_err(|e| Error::io(path, e))?.len();
    let options = SummaryReaderOptions::default().with_file_size(bytes).with_record_length_limit(MAX_RECORD_BYTES);
    let mut reader = SummaryReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event {
            Ok(SummaryReadEvent::ReadRequest(bytes)) => {
                let read = file.read(reader.insert(bytes)).map_err(|e| Error::io(path, e))?;
                reader.notify_read(read);
            }
            Ok(SummaryReadEvent::SeekRequest(to)) => {
                reader.notify_seeked(file.seek(to).map_err(|e| Error::io(path, e))?);
            }
            Err(_) => return Ok(None),
        }
    }
    Ok(reader.finish().filter(|summary| summary.stats.is_some()))
}

/// The first attachment of a name; `None` where there is none.
///
/// # Errors
/// As [`contents`].
pub fn attachment(path: &Path, name: &str) -> Result<Option<Vec<u8>>> {
    let paths = [path.to_path_buf()];
    let subject = path.display().to_string();
    if summary(path)?.is_some_and(|summary| !summary.attachment_indexes.iter().any(|index| index.name == name)) {
        return Ok(None);
    }
    let mut records = Records::open(&paths, &subject)?;
    while let Some(record) = records.next(|_| false)? {
        if let Record::Attachment(attachment) = record
            && attachment.name == name
        {
            return Ok(Some(attachment.data));
        }
    }
    Ok(None)
}
