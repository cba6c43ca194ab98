//! A ROS 2 node by hiroz, which shares no code with Farside, for `tests/node/ros/test_independent_peer.py`.
//!
//! `farside-peer ENDPOINT PACKAGE...`: packages are folders with msg/ and srv/, as ROS 2 has them. Each line on standard
//! input is one command as JSON; what comes of it are lines of JSON on standard output. It ends with its input.
//!
//!     {"graph": "/farside"}                              what the node publishes, takes and serves; and each hash as
//!                                                        hiroz computes it
//!     {"listen": TOPIC, "type": TYPE}                    every message from then on
//!     {"call": SERVICE, "type": TYPE, "request": {...}}  one response; or {"raw": HEX} in place of the request
//!     {"discover": TOPIC}                                fields and hash of its type, from ~/get_type_description
//!     {"publish": [{"topic": ..., "type": ..., "message": {...}, "latched": false}, ...], "period_s": 0.2}
//!                                                        again and again, with the time of each round as header.stamp

mod types;

use std::io::BufRead;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use byteorder::ByteOrder;
use hiroz::Builder;
use hiroz::context::ZContextBuilder;
use hiroz::dynamic::{DynamicMessage, DynamicValue};
use hiroz::entity::{EndpointEntity, EndpointKind};
use hiroz::msg::ZService;
use hiroz::node::ZNode;
use hiroz::qos::{QosDurability, QosHistory, QosProfile};
use hiroz_cdr::{CdrBuffer, CdrDeserialize, CdrReader, CdrSerialize, CdrSerializedSize, CdrWriter};
use serde_json::{Value, json};
use types::{Trouble, Types};

const PATIENCE: Duration = Duration::from_secs(30);

/// CDR after its header, as it came or is to go: what it means is worked out by `DynamicMessage`.
struct Body(Vec<u8>);

impl CdrSerialize for Body {
    fn cdr_serialize<BO: ByteOrder, B: CdrBuffer>(&self, writer: &mut CdrWriter<'_, BO, B>) {
        writer.buffer_mut().extend_from_slice(&self.0);
    }
}

impl CdrDeserialize for Body {
    fn cdr_deserialize<'de, BO: ByteOrder>(reader: &mut CdrReader<'de, BO>) -> hiroz_cdr::Result<Self> {
        Ok(Body(reader.read_bytes(reader.remaining())?.to_vec()))
    }
}

impl CdrSerializedSize for Body {
    fn cdr_serialized_size(&self, _: usize) -> usize {
        self.0.len()
    }
}

struct Service;

impl ZService for Service {
    type Request = Body;
    type Response = Body;
}

#[tokio::main]
async fn main() -> Result<(), Trouble> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let folders: Vec<_> = arguments.iter().skip(1).map(Into::into).collect();
    let types = Arc::new(Types::read(&folders)?);
    let context = ZContextBuilder::default()
        .disable_multicast_scouting()
        .with_listen_endpoints(["tcp/127.0.0.1:0"])
        .with_connect_endpoints([arguments.first().ok_or("give an endpoint")?.as_str()])
        .build()?;
    let node = Arc::new(context.create_node("independent_peer").build()?);
    say(json!({"what": "ready"}));
    for line in std::io::stdin().lock().lines() {
        let command: Value = serde_json::from_str(&line?)?;
        if let Err(error) = obey(&node, &types, &command).await {
            say(json!({"what": "error", "command": short(&command), "error": error.to_string()}));
        }
    }
    Ok(())
}

fn say(line: Value) {
    println!("{line}");
}

fn short(command: &Value) -> Value {
    command.get("publish").map_or(command.clone(), |_| json!("publish"))
}

async fn obey(node: &Arc<ZNode>, types: &Arc<Types>, command: &Value) -> Result<(), Trouble> {
    if let Some(name) = command["graph"].as_str() {
        graph(node, types, name)
    } else if let Some(topic) = command["listen"].as_str() {
        listen(node, types, topic, text(command, "type")?)
    } else if let Some(service) = command["call"].as_str() {
        say(call(node, types, service, text(command, "type")?, command).await?);
        Ok(())
    } else if let Some(topic) = command["discover"].as_str() {
        let found = node.discover_topic_schema(topic, PATIENCE).await?;
        let fields: Vec<&str> = found.schema.field_names().collect();
        say(json!({"what": "discovered", "name": topic, "type": found.schema.type_name, "hash": found.type_hash,
            "fields": fields}));
        Ok(())
    } else {
        publish(node, types, command)
    }
}

fn text<'a>(command: &'a Value, name: &str) -> Result<&'a str, Trouble> {
    Ok(command[name].as_str().ok_or_else(|| format!("{name} is missing"))?)
}

fn endpoints(node: &ZNode, kind: EndpointKind, full_name: &str) -> Vec<EndpointEntity> {
    let (space, name) = full_name.rsplit_once('/').unwrap_or(("", full_name));
    node.graph().get_entities_by_node(kind, (space.to_string(), name.to_string()))
}

fn graph(node: &ZNode, types: &Types, name: &str) -> Result<(), Trouble> {
    let kinds = [
        (EndpointKind::Publisher, "publisher"),
        (EndpointKind::Subscription, "subscription"),
        (EndpointKind::Service, "service"),
    ];
    for (kind, role) in kinds {
        for it in endpoints(node, kind, name) {
            let info = it.type_info.as_ref().ok_or("an endpoint without a type")?;
            let ros = info.name.replace("::dds_::", "/").replace("::", "/");
            let ros = ros.trim_end_matches('_');
            let computed = types.hash(ros).unwrap_or("unknown");
            say(json!({"what": "endpoint", "role": role, "name": it.topic, "type": ros,
                "hash": info.hash.to_rihs_string(), "computed": computed,
                "durability": format!("{:?}", it.qos.durability), "reliability": format!("{:?}", it.qos.reliability),
                "depth": it.qos.history.depth()}));
        }
    }
    say(json!({"what": "graph", "name": name}));
    Ok(())
}

/// Quality of service as a publisher of the topic states it.
fn quality(node: &ZNode, topic: &str) -> QosProfile {
    let stated = node.graph().get_entities_by_topic(EndpointKind::Publisher, topic);
    let latched = stated.iter().any(|it| format!("{it:?}").contains("TransientLocal"));
    profile(latched, 50)
}

fn profile(latched: bool, depth: usize) -> QosProfile {
    QosProfile {
        durability: if latched { QosDurability::TransientLocal } else { QosDurability::Volatile },
        history: QosHistory::from_depth(depth),
        ..Default::default()
    }
}

fn listen(node: &Arc<ZNode>, types: &Types, topic: &str, kind: &str) -> Result<(), Trouble> {
    let (schema, info) = (types.schema(kind)?, types.info(kind)?);
    let subscriber = node.create_sub_impl::<Body>(topic, Some(info)).with_qos(quality(node, topic)).build()?;
    let (topic, kind) = (topic.to_string(), kind.to_string());
    std::thread::spawn(move || {
        while let Ok(sample) = subscriber.recv_serialized() {
            let data = sample.payload().to_bytes();
            say(match DynamicMessage::from_cdr(&data, &schema) {
                Ok(message) => json!({"what": "heard", "name": topic, "type": kind, "bytes": data.len(),
                    "same": same(&message, &data), "message": types::to_json(&message)}),
                Err(error) => json!({"what": "error", "name": topic, "type": kind, "error": error.to_string()}),
            });
        }
    });
    Ok(())
}

/// Whether hiroz writes the same bytes.
fn same(message: &DynamicMessage, data: &[u8]) -> bool {
    message.to_cdr().is_ok_and(|again| again == data)
}

async fn call(node: &ZNode, types: &Types, name: &str, kind: &str, command: &Value) -> Result<Value, Trouble> {
    let client = node.create_client_impl::<Service>(name, Some(types.info(kind)?)).build()?;
    let body = match command["raw"].as_str() {
        Some(hex) => {
            (0..hex.len()).step_by(2).map(|k| u8::from_str_radix(&hex[k..k + 2], 16)).collect::<Result<Vec<u8>, _>>()?
        }
        None => {
            types::message(&types.schema(&format!("{kind}_Request"))?, &command["request"])?.to_cdr()?[4..].to_vec()
        }
    };
    let answer = client.call_with_timeout(&Body(body), PATIENCE).await?;
    let data = [&[0u8, 1, 0, 0][..], &answer.0].concat();
    let response = DynamicMessage::from_cdr(&data, &types.schema(&format!("{kind}_Response"))?)?;
    Ok(json!({"what": "answer", "name": name, "type": kind, "bytes": data.len(), "same": same(&response, &data),
        "response": types::to_json(&response)}))
}

fn publish(node: &Arc<ZNode>, types: &Types, command: &Value) -> Result<(), Trouble> {
    let mut topics = Vec::new();
    for it in command["publish"].as_array().ok_or("no such command")? {
        let (topic, kind) = (text(it, "topic")?, text(it, "type")?);
        let message = types::message(&types.schema(kind)?, &it["message"])?;
        let profile = profile(it["latched"] == true, 10);
        let publisher = node.create_pub_impl::<Body>(topic, Some(types.info(kind)?)).with_qos(profile).build()?;
        topics.push((publisher, message));
    }
    let period = Duration::from_secs_f64(command["period_s"].as_f64().unwrap_or(0.2));
    std::thread::spawn(move || {
        loop {
            let now = SystemTime::now().duration_since(UNIX_EPOCH).expect("a clock after 1970");
            for (publisher, message) in &mut topics {
                if message.schema().field("header").is_some() {
                    message
                        .set_dynamic("header.stamp.sec", DynamicValue::Int32(now.as_secs() as i32))
                        .expect("a stamp");
                    message
                        .set_dynamic("header.stamp.nanosec", DynamicValue::Uint32(now.subsec_nanos()))
                        .expect("a stamp");
                }
                let body = message.to_cdr().expect("it was made to fit")[4..].to_vec();
                if let Err(error) = publisher.publish(&Body(body)) {
                    say(json!({"what": "error", "name": publisher.entity().topic, "error": error.to_string()}));
                }
            }
            std::thread::sleep(period);
        }
    });
    Ok(())
}
