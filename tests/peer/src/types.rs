//! Types from .msg and .srv files, their hashes, and messages as JSON: all by hiroz.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use hiroz::dynamic::registry::parsed_message_to_schema;
use hiroz::dynamic::{DynamicMessage, DynamicValue, FieldType, MessageSchema};
use hiroz::entity::{TypeHash, TypeInfo};
use hiroz_codegen::types::ParsedMessage;
use hiroz_codegen::{bundled_assets_dir_for, discovery, resolver::Resolver};
use serde_json::{Map, Value, json};

const WHOLE: usize = 32; // numbers of an array that are printed; of a longer one so many, and what all are like

pub type Trouble = Box<dyn std::error::Error + Send + Sync>;

/// What is known of ROS 2: Jazzy's packages as hiroz has them, vision_msgs, and the packages in the given folders.
pub struct Types {
    messages: HashMap<String, ParsedMessage>, // pkg/msg/Name, pkg/srv/Name_Request, pkg/srv/Name_Response
    hashes: HashMap<String, String>,          // RIHS01_... by pkg/msg/Name and pkg/srv/Name
}

impl Types {
    pub fn read(folders: &[PathBuf]) -> Result<Self, Trouble> {
        let mut packages: Vec<PathBuf> = std::fs::read_dir(bundled_assets_dir_for("jazzy"))?
            .map(|entry| entry.map(|e| e.path()))
            .collect::<Result<_, _>>()?;
        packages.retain(|path| path.join("msg").is_dir() || path.join("srv").is_dir());
        packages.push(bundled_assets_dir_for("lyrical").join("vision_msgs"));
        packages.extend_from_slice(folders);
        let paths: Vec<&Path> = packages.iter().map(PathBuf::as_path).collect();
        let (mut messages, services, _) = discovery::discover_all(&paths)?;
        messages.retain(|it| it.fields.iter().all(|field| field.field_type.base_type != "wstring")); // it hashes none
        let mut resolver = Resolver::new(false);
        let mut known = Self { messages: HashMap::new(), hashes: HashMap::new() };
        for message in resolver.resolve_messages(messages)? {
            let name = format!("{}/msg/{}", message.parsed.package, message.parsed.name);
            known.hashes.insert(name.clone(), message.type_hash.to_rihs_string());
            known.messages.insert(name, message.parsed);
        }
        for service in resolver.resolve_services(services)? {
            let name = format!("{}/srv/{}", service.parsed.package, service.parsed.name);
            known.hashes.insert(name.clone(), service.type_hash.to_rihs_string());
            known.messages.insert(format!("{name}_Request"), service.parsed.request);
            known.messages.insert(format!("{name}_Response"), service.parsed.response);
        }
        Ok(known)
    }

    /// The hash of a message or service, computed by hiroz from its definition.
    pub fn hash(&self, kind: &str) -> Result<&str, Trouble> {
        Ok(self.hashes.get(kind).ok_or_else(|| format!("{kind} is unknown"))?)
    }

    pub fn info(&self, kind: &str) -> Result<TypeInfo, Trouble> {
        let hash = TypeHash::from_rihs_string(self.hash(kind)?).ok_or("no RIHS01")?;
        let parts: Vec<&str> = kind.split('/').collect();
        Ok(TypeInfo::new(&format!("{}::{}::dds_::{}_", parts[0], parts[1], parts[2]), hash))
    }

    pub fn schema(&self, kind: &str) -> Result<Arc<MessageSchema>, Trouble> {
        let mut parsed = self.messages.get(kind).ok_or_else(|| format!("{kind} is unknown"))?.clone();
        for field in &mut parsed.fields {
            field.field_type.package.get_or_insert_with(|| parsed.package.clone());
        }
        let inner = |package: &str, name: &str| self.schema(&format!("{package}/msg/{name}")).ok();
        Ok(parsed_message_to_schema(&parsed, &inner)?)
    }
}

/// A message of the fields that JSON gives; what it omits is zero or empty. Bytes may be a string of hex digits.
pub fn message(schema: &Arc<MessageSchema>, given: &Value) -> Result<DynamicMessage, Trouble> {
    let mut made = DynamicMessage::new(schema);
    for (name, value) in given.as_object().ok_or_else(|| format!("{given} is no object"))? {
        let field = schema.field(name).ok_or_else(|| format!("{} has no {name}", schema.type_name))?;
        made.set_dynamic(name, from_json(&field.field_type, value)?)?;
    }
    Ok(made)
}

fn from_json(kind: &FieldType, value: &Value) -> Result<DynamicValue, Trouble> {
    let wrong = || format!("{value} is no {kind:?}");
    let whole = || value.as_i64().ok_or_else(wrong);
    let real = || match value {
        Value::Null => Ok(f64::NAN), // JSON knows none
        _ => value.as_f64().ok_or_else(wrong),
    };
    Ok(match kind {
        FieldType::Bool => DynamicValue::Bool(value.as_bool().ok_or_else(wrong)?),
        FieldType::Int8 => DynamicValue::Int8(whole()?.try_into()?),
        FieldType::Int16 => DynamicValue::Int16(whole()?.try_into()?),
        FieldType::Int32 => DynamicValue::Int32(whole()?.try_into()?),
        FieldType::Int64 => DynamicValue::Int64(whole()?),
        FieldType::Uint8 => DynamicValue::Uint8(whole()?.try_into()?),
        FieldType::Uint16 => DynamicValue::Uint16(whole()?.try_into()?),
        FieldType::Uint32 => DynamicValue::Uint32(whole()?.try_into()?),
        FieldType::Uint64 => DynamicValue::Uint64(value.as_u64().ok_or_else(wrong)?),
        FieldType::Float32 => DynamicValue::Float32(real()? as f32),
        FieldType::Float64 => DynamicValue::Float64(real()?),
        FieldType::String | FieldType::BoundedString(_) => {
            DynamicValue::String(value.as_str().ok_or_else(wrong)?.to_string())
        }
        FieldType::Message(schema) => DynamicValue::Message(Box::new(message(schema, value)?)),
        FieldType::Array(inner, _) | FieldType::Sequence(inner) | FieldType::BoundedSequence(inner, _) => match value {
            Value::String(hex) if **inner == FieldType::Uint8 => DynamicValue::Bytes(
                (0..hex.len()).step_by(2).map(|k| u8::from_str_radix(&hex[k..k + 2], 16)).collect::<Result<_, _>>()?,
            ),
            Value::Array(items) => {
                DynamicValue::Array(items.iter().map(|it| from_json(inner, it)).collect::<Result<_, _>>()?)
            }
            _ => return Err(wrong().into()),
        },
    })
}

/// A message as JSON. Of a long array: how many, the first, and of numbers the least and the largest.
pub fn to_json(message: &DynamicMessage) -> Value {
    Value::Object(message.iter().map(|(name, value)| (name.to_string(), value_json(value))).collect::<Map<_, _>>())
}

fn value_json(value: &DynamicValue) -> Value {
    match value {
        DynamicValue::Bool(v) => json!(v),
        DynamicValue::Int8(v) => json!(v),
        DynamicValue::Int16(v) => json!(v),
        DynamicValue::Int32(v) => json!(v),
        DynamicValue::Int64(v) => json!(v),
        DynamicValue::Uint8(v) => json!(v),
        DynamicValue::Uint16(v) => json!(v),
        DynamicValue::Uint32(v) => json!(v),
        DynamicValue::Uint64(v) => json!(v),
        DynamicValue::Float32(v) => json!(v),
        DynamicValue::Float64(v) => json!(v),
        DynamicValue::String(v) => json!(v),
        DynamicValue::Message(v) => to_json(v),
        DynamicValue::Bytes(v) => array_json(v.len(), v.iter().map(|byte| json!(byte))),
        DynamicValue::Array(v) => array_json(v.len(), v.iter().map(value_json)),
    }
}

fn array_json(count: usize, items: impl Iterator<Item = Value> + Clone) -> Value {
    if count <= WHOLE {
        return Value::Array(items.collect());
    }
    let first: Vec<Value> = items.clone().take(WHOLE).collect();
    let (mut least, mut largest) = (f64::INFINITY, f64::NEG_INFINITY);
    if first[0].is_object() || first[0].is_string() {
        return json!({"count": count, "first": first});
    }
    for number in items.filter_map(|it| it.as_f64()) {
        (least, largest) = (least.min(number), largest.max(number));
    }
    json!({"count": count, "first": first, "least": least, "largest": largest})
}
