//! An MCAP file as the frames of a run: archives of Stria, Foxglove's schemas, and bags of ROS 2.
//!
//! Messages are read in the order of the file, which is their decoding order; a frame's time is the one in its own
//! header. A file that was cut off gives what it holds, with a warning.

mod cdr;
mod decoder;
mod messages;
mod odometry;

use std::path::{Path, PathBuf};

use self::decoder::{Pictures, TimedPicture};
use self::messages::{ImageMessage, Packing, Role, image, role};
use super::encoded::is_key;
use super::folder::natural_order;
use super::{Beside, EncodedFrame, Frame, Source, SourceInfo, VideoFacts};
use crate::error::{Error, Result};
use crate::mcap_file::{self, Contents, Message, Record, Records, Topic, TopicFacts};

pub use self::messages::CameraFacts;
pub(crate) use self::odometry::to_csv as odometry_csv;

/// The metadata record in which an archive says what its container said of the video.
pub(crate) const VIDEO_METADATA: &str = "video";

/// The attachment in which an archive keeps the robot's own odometry, as it was used.
pub(crate) const ODOMETRY_CSV: &str = "odometry.csv";

/// The MCAP files at a path: the file itself, or those of a bag's folder in their order; `None` where there are none.
pub(super) fn files(path: &Path) -> Result<Option<Vec<PathBuf>>> {
    if path.is_file() {
        return Ok(mcap_file::is_mcap(path).then(|| vec![path.to_path_buf()]));
    }
    if !path.is_dir() {
        return Ok(None);
    }
    let mut files = Vec::new();
    for entry in std::fs::read_dir(path).map_err(|e| Error::io(path, e))? {
        let file = entry.map_err(|e| Error::io(path, e))?.path();
        if file.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mcap")) && file.is_file() {
            files.push(file);
        }
    }
    files.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
    Ok((!files.is_empty()).then_some(files))
}

/// What a topic can give a run, in a word; `None` where it is of no use.
pub(super) fn use_of(topic: &Topic) -> Option<&'static str> {
    match role(topic)? {
        Role::Images(_) if is_depth(topic) => None,
        Role::Images(_) => Some("images"),
        Role::Camera => Some("camera"),
        Role::Odometry => Some("odometry"),
        Role::FixedTransforms => Some("transforms"),
    }
}

/// By its name, as nothing else says so before the pixels do.
fn is_depth(topic: &Topic) -> bool {
    topic.name.contains("depth")
}

/// When the first image was captured, ns since the epoch; `None` where there is none.
pub(super) fn start_ns(files: &[PathBuf], name: &str, topics: &[String]) -> Result<Option<u64>> {
    let choice = Choice::of(&mcap_file::contents(files, name)?, name, topics)?;
    let mut messages = ImageMessages::open(files, name, &choice)?;
    while let Some(next) = messages.next()? {
        if let Next::Image(image, _) = next {
            return Ok(Some(image.time_ns));
        }
    }
    Ok(None)
}

/// The topics that a run is read from.
struct Choice {
    images: TopicFacts,
    packing: Packing,
    odometry: Option<String>,
    camera: Option<String>,
    notes: Vec<String>,
}

impl Choice {
    /// The topics that the caller named, and for the rest a guess.
    fn of(contents: &Contents, name: &str, topics: &[String]) -> Result<Choice> {
        let wanted = |role_wanted: fn(Role) -> bool| -> Vec<&TopicFacts> {
            let fits = |facts: &&TopicFacts| role(&facts.topic).is_some_and(role_wanted) && facts.messages > 0;
            let all: Vec<&TopicFacts> = contents.topics.iter().filter(fits).collect();
            let named = all.iter().filter(|facts| topics.contains(&facts.topic.name)).copied().collect::<Vec<_>>();
            if named.is_empty() { all } else { named }
        };
        check_names(contents, name, topics)?;
        let mut images = wanted(|role| matches!(role, Role::Images(_)));
        // Depth images show no laser line; of the rest the topic with the most frames is the likeliest.
        if images.iter().any(|facts| !is_depth(&facts.topic)) && !images.iter().any(|i| topics.contains(&i.topic.name))
        {
            images.retain(|facts| !is_depth(&facts.topic));
        }
        images.sort_by_key(|facts| std::cmp::Reverse(facts.messages));
        let Some(&first) = images.first() else {
            return Err(Error::input(
                name,
                format!("no topic with images among {}", listed(contents)),
                "a topic of foxglove.CompressedVideo, CompressedImage or RawImage, or of sensor_msgs/msg/CompressedImage or Image",
            ));
        };
        let Some(Role::Images(packing)) = role(&first.topic) else { unreachable!("only such were asked for") };
        let mut notes = Vec::new();
        if images.len() > 1 {
            let others: Vec<&str> = images[1..].iter().map(|facts| facts.topic.name.as_str()).collect();
            notes.push(format!(
                "{name}: the frames are those of {}, not of {}; --topic chooses",
                first.topic.name,
                others.join(", ")
            ));
        }
        let odometry = wanted(|role| role == Role::Odometry);
        if odometry.len() > 1 {
            let names: Vec<&str> = odometry.iter().map(|facts| facts.topic.name.as_str()).collect();
            notes.push(format!("{name}: {} are odometry; the first is used, --topic chooses", names.join(", ")));
        }
        let mut cameras = wanted(|role| role == Role::Camera);
        cameras.sort_by_key(|facts| std::cmp::Reverse(shared_parts(&facts.topic.name, &first.topic.name)));
        Ok(Choice {
            images: first.clone(),
            packing,
            odometry: odometry.first().map(|facts| facts.topic.name.clone()),
            camera: cameras.first().map(|facts| facts.topic.name.clone()),
            notes,
        })
    }
}

/// How many parts of their names two topics share from the start.
fn shared_parts(a: &str, b: &str) -> usize {
    a.split('/').zip(b.split('/')).take_while(|(a, b)| a == b).count()
}

fn check_names(contents: &Contents, name: &str, topics: &[String]) -> Result<()> {
    for wanted in topics {
        let expected = || format!("one of {}", listed(contents));
        match contents.topics.iter().find(|facts| facts.topic.name == *wanted) {
            None => return Err(Error::field(name, "--topic", format!("`{wanted}`, which it has not"), expected())),
            Some(facts) if role(&facts.topic).is_none() => {
                let found = format!("`{wanted}` of {} ({})", facts.topic.schema, facts.topic.encoding);
                return Err(Error::field(name, "--topic", found, "images, a CameraInfo or an Odometry"));
            }
            Some(_) => {}
        }
    }
    Ok(())
}

fn listed(contents: &Contents) -> String {
    match contents.topics.as_slice() {
        [] => "no topics at all".into(),
        some => some.iter().map(|facts| facts.topic.name.as_str()).collect::<Vec<_>>().join(", "),
    }
}

/// The messages of the chosen topic, in the order of the file.
struct ImageMessages {
    records: Records,
    topic: String,
    packing: Packing,
}

/// What comes next in a file.
enum Next {
    Image(ImageMessage, Message),
    Unusable(String),
    Video(VideoFacts),
}

impl ImageMessages {
    fn open(files: &[PathBuf], name: &str, choice: &Choice) -> Result<ImageMessages> {
        let records = Records::open(files, name)?;
        Ok(ImageMessages { records, topic: choice.images.topic.name.clone(), packing: choice.packing })
    }

    fn next(&mut self) -> Result<Option<Next>> {
        let (wanted, packing) = (&self.topic, self.packing);
        let mine = |topic: &Topic| topic.name == *wanted && role(topic) == Some(Role::Images(packing));
        while let Some(record) = self.records.next(mine)? {
            match record {
                Record::Message(message) => {
                    let image = image(packing, &message);
                    return Ok(Some(image.map_or_else(Next::Unusable, |image| Next::Image(image, message))));
                }
                Record::Metadata { name, values } if name == VIDEO_METADATA => {
                    return Ok(Some(Next::Video(VideoFacts::from_metadata(&values))));
                }
                _ => {}
            }
        }
        Ok(None)
    }
}

/// The chosen topic's pictures.
struct PictureReader {
    messages: ImageMessages,
    pictures: Pictures,
    name: String,
    /// The camera's frame of reference, as the first image says.
    camera_frame: Option<String>,
    ended: bool,
}

impl PictureReader {
    fn next(&mut self) -> Result<Option<TimedPicture>> {
        loop {
            if let Some(picture) = self.pictures.pop() {
                return Ok(Some(picture));
            }
            if self.ended {
                return Ok(None);
            }
            match self.messages.next()? {
                Some(Next::Image(image, _)) => {
                    self.camera_frame.get_or_insert_with(|| image.frame_id.clone());
                    self.pictures.push(image)?;
                }
                Some(Next::Unusable(why)) => self.pictures.refuse(&why),
                Some(Next::Video(facts)) => self.pictures = Pictures::new(&self.name, facts),
                None => {
                    self.ended = true;
                    self.pictures.end()?;
                }
            }
        }
    }
}

/// An open file.
pub(super) struct McapFile {
    info: SourceInfo,
    name: String,
    reader: PictureReader,
    /// Read ahead for its size.
    first: Option<TimedPicture>,
    first_ns: u64,
    last_time_s: f64,
    next: u32,
    beside: Beside,
    notes: Vec<String>,
}

impl McapFile {
    pub(super) fn open(files: Vec<PathBuf>, name: &str, topics: &[String]) -> Result<McapFile> {
        let contents = mcap_file::contents(&files, name)?;
        let choice = Choice::of(&contents, name, topics)?;
        let mut reader = PictureReader {
            messages: ImageMessages::open(&files, name, &choice)?,
            pictures: Pictures::new(name, VideoFacts::default()),
            name: name.into(),
            camera_frame: None,
            ended: false,
        };
        let topic = &choice.images.topic.name;
        let Some(first) = reader.next()? else {
            let why = reader.pictures.warning().map_or_else(String::new, |why| format!(" ({why})"));
            return Err(Error::input(name, format!("no image in {topic} that can be read{why}"), "images"));
        };
        let wanted = odometry::Wanted {
            odometry: choice.odometry.as_deref(),
            camera: choice.camera.as_deref(),
            camera_frame: reader.camera_frame.as_deref().unwrap_or_default(),
            start_ns: first.time_ns,
        };
        let mut found = odometry::read(&files, name, &wanted)?;
        if choice.odometry.is_none() && contents.attachments.iter().any(|file| file == ODOMETRY_CSV) {
            let text = files.first().map(|file| mcap_file::attachment(file, ODOMETRY_CSV)).transpose()?.flatten();
            found.poses = odometry::from_csv(&text.unwrap_or_default(), name)?;
        }
        let (messages, length_s) = (choice.images.messages, (contents.end_ns - contents.start_ns) as f64 / 1e9);
        let info = SourceInfo {
            width_px: first.image.width_px(),
            height_px: first.image.height_px(),
            frames_announced: Some(messages),
            frames_per_s: (messages > 1 && length_s > 0.0).then(|| (messages - 1) as f64 / length_s),
            files,
            still_open: false,
        };
        Ok(McapFile {
            info,
            name: name.into(),
            reader,
            first_ns: first.time_ns,
            first: Some(first),
            last_time_s: 0.0,
            next: 0,
            beside: Beside { poses: found.poses, camera: found.camera },
            notes: choice.notes.into_iter().chain(found.warnings).collect(),
        })
    }
}

impl Source for McapFile {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Frame>> {
        let picture = match self.first.take() {
            Some(first) => Some(first),
            None => self.reader.next()?,
        };
        let Some(picture) = picture else { return Ok(None) };
        let since_first_s = (i128::from(picture.time_ns) - i128::from(self.first_ns)) as f64 / 1e9;
        self.last_time_s = since_first_s.max(self.last_time_s);
        let frame = Frame { index: self.next, time_s: self.last_time_s, image: picture.image };
        self.next += 1;
        Ok(Some(frame))
    }

    fn warnings(&self) -> Vec<String> {
        let mut warnings = self.notes.clone();
        warnings.extend(self.reader.messages.records.damage().map(String::from));
        warnings.extend(self.reader.pictures.warning());
        let announced = self.info.frames_announced.unwrap_or(0);
        if self.reader.ended && u64::from(self.next) < announced && warnings.is_empty() {
            warnings.push(format!(
                "{}: {announced} images are announced, {} could be read; what is there was processed",
                self.name, self.next
            ));
        }
        warnings
    }

    fn beside(&self) -> Beside {
        self.beside.clone()
    }
}

/// The images of the chosen topic, not decoded.
pub(super) struct McapPackets {
    messages: ImageMessages,
    pending: Option<Result<EncodedFrame>>,
    start: Option<(u64, u64)>,
    facts: Option<VideoFacts>,
}

impl McapPackets {
    pub(super) fn open(files: &[PathBuf], name: &str, topics: &[String]) -> Result<McapPackets> {
        let contents = mcap_file::contents(files, name)?;
        let choice = Choice::of(&contents, name, topics)?;
        let messages = ImageMessages::open(files, name, &choice)?;
        let mut packets = McapPackets { messages, pending: None, start: None, facts: None };
        // What the file says of its video stands before the first frame.
        packets.pending = packets.read();
        Ok(packets)
    }

    pub(super) fn facts(&self) -> Option<VideoFacts> {
        self.facts.clone()
    }

    pub(super) fn next(&mut self) -> Option<Result<EncodedFrame>> {
        match self.pending.take() {
            Some(frame) => Some(frame),
            None => self.read(),
        }
    }

    fn read(&mut self) -> Option<Result<EncodedFrame>> {
        loop {
            let (image, message) = match self.messages.next() {
                Ok(Some(Next::Image(image, message))) => (image, message),
                // The frames' own reading says so in its warnings.
                Ok(Some(Next::Unusable(_))) => continue,
                Ok(Some(Next::Video(facts))) => {
                    self.facts = Some(facts);
                    continue;
                }
                Ok(None) => return None,
                Err(error) => return Some(Err(error)),
            };
            let (time_ns, order_ns) = *self.start.get_or_insert((image.time_ns, message.log_time_ns));
            let since = |now: u64, start: u64| (i128::from(now) - i128::from(start)) as f64 / 1e9;
            let time_s = since(image.time_ns, time_ns);
            let key = is_key(image.format, &image.data);
            let order_s = if image.format.is_video() { since(message.log_time_ns, order_ns) } else { time_s };
            return Some(Ok(EncodedFrame { time_s, order_s, format: image.format, key, data: image.data }));
        }
    }
}
