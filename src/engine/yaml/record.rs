//! The two macros by which a file's shape is said once.

/// A struct that is a map in the file, with its strict reader and its JSON Schema.
///
/// Each field is a key of the same name (`r#type` is `type`). A field with `= default` may be left
/// out, so may an `Option`; any other must be there. An unknown key is a fault. The doc comments
/// are the schema's descriptions. The struct gets one more field, `place`: the key that the map
/// stands under, or its beginning. See the module's example.
///
/// `record! { pub struct Point { … } and form: Form }` takes the keys of the record `Form` into the
/// same map, so that two records that share keys say them once.
#[macro_export]
macro_rules! record {
    ($(#[doc = $doc:literal])* $visibility:vis struct $name:ident {
        $($(#[doc = $field_doc:literal])* $field:ident: $type:ty $(= $default:expr)?,)*
    } $(and $part:ident: $part_type:ty)?) => {
        $(#[doc = $doc])*
        #[derive(Clone, Debug)]
        $visibility struct $name {
            /// Where it stands.
            pub place: $crate::engine::yaml::Place,
            $($(#[doc = $field_doc])* pub $field: $type,)*
            $(
                /// Keys of the same map that other records have as well.
                pub $part: $part_type,
            )?
        }

        impl $crate::engine::yaml::Record for $name {
            fn keys() -> Vec<&'static str> {
                [vec![$(stringify!($field)),*], $(<$part_type as $crate::engine::yaml::Record>::keys())?].concat()
            }

            fn of(
                keys: &$crate::engine::yaml::Keys<'_>,
                faults: &mut $crate::engine::yaml::Faults,
            ) -> Option<$name> {
                $(let $field = keys.value::<$type>(
                    stringify!($field), $crate::record!(@default $type $(, $default)?), faults,
                );)*
                $(let $part = <$part_type as $crate::engine::yaml::Record>::of(keys, faults);)?
                Some($name { place: keys.place().clone(), $($field: $field?,)* $($part: $part?,)? })
            }

            fn schemas(
                definitions: &mut $crate::engine::yaml::Definitions,
            ) -> Vec<$crate::engine::yaml::KeySchema> {
                [
                    vec![$($crate::engine::yaml::KeySchema {
                        name: stringify!($field),
                        description: concat!($($field_doc, "\n"),*),
                        required: $crate::record!(@required $type $(, $default)?),
                        schema: <$type as $crate::engine::yaml::Read>::schema(definitions),
                    }),*],
                    $(<$part_type as $crate::engine::yaml::Record>::schemas(definitions),)?
                ].concat()
            }
        }

        impl $crate::engine::yaml::Read for $name {
            fn read(
                node: &$crate::engine::yaml::Node,
                faults: &mut $crate::engine::yaml::Faults,
            ) -> Option<$name> {
                use $crate::engine::yaml::{Keys, Record};
                <$name>::of(&Keys::of(node, &<$name>::keys(), faults)?, faults)
            }

            fn schema(
                definitions: &mut $crate::engine::yaml::Definitions,
            ) -> $crate::engine::yaml::Json {
                use $crate::engine::yaml::{Keys, Record};
                definitions.refer(stringify!($name), |definitions| {
                    Keys::schema(concat!($($doc, "\n"),*), <$name>::schemas(definitions))
                })
            }
        }
    };
    (@default $type:ty) => { <$type as $crate::engine::yaml::Read>::absent() };
    (@default $type:ty, $default:expr) => { Some($default) };
    (@required $type:ty) => { <$type as $crate::engine::yaml::Read>::absent().is_none() };
    (@required $type:ty, $default:expr) => { false };
}

/// How the words of a file become the values of an enumeration.
///
/// The first word says what the enumeration is, with its article, for messages.
#[macro_export]
macro_rules! choices {
    ($what:literal, $type:ty { $($word:literal => $value:expr),* $(,)? }) => {
        impl $crate::engine::yaml::Scalar for $type {
            const EXPECTED: &'static str = $what;

            fn parse(text: &str) -> Result<$type, String> {
                match text {
                    $($word => Ok($value),)*
                    _ => Err(format!(
                        "`{text}` is not {}; {}",
                        $what,
                        $crate::engine::yaml::list_of_choices(text, &[$($word),*]),
                    )),
                }
            }

            fn schema() -> $crate::engine::yaml::Json {
                $crate::engine::yaml::schema_of_choices(&[$($word),*])
            }
        }
    };
}

pub use {choices, record};
