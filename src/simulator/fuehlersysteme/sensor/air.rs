//! What follows from temperature, humidity and pressure: Rreg_03 to 06, 21, and the volume flows 40 to 45.
//!
//! The manual names these quantities (page 5) and gives formulas for the volume flows alone (page 11).
//! The others are the usual ones: vapour pressure over water by Magnus, the psychrometer for the wet
//! bulb, the international barometric formula.

/// hPa of saturated vapour.
fn saturation(celsius: f64) -> f64 {
    6.112 * libm::exp(17.62 * celsius / (243.12 + celsius))
}

/// hPa of the vapour that is there; `humidity` in percent.
fn vapour(celsius: f64, humidity: f64) -> f64 {
    saturation(celsius) * humidity / 100.0
}

/// Grams of water in a cubic metre.
pub fn absolute_humidity(celsius: f64, humidity: f64) -> f64 {
    216.7 * vapour(celsius, humidity) / (273.15 + celsius)
}

/// Grams of water to a kilogram of dry air.
pub fn mixing_ratio(celsius: f64, humidity: f64, millibars: f64) -> f64 {
    let vapour = vapour(celsius, humidity);
    // Above the boiling point all of it may be vapour.
    if vapour < millibars { 622.0 * vapour / (millibars - vapour) } else { f64::INFINITY }
}

/// °C at which dew falls; minus infinity in dry air.
pub fn dew_point(celsius: f64, humidity: f64) -> f64 {
    let vapour = vapour(celsius, humidity);
    if vapour <= 0.0 {
        return f64::NEG_INFINITY;
    }
    let logarithm = libm::log(vapour / 6.112);
    243.12 * logarithm / (17.62 - logarithm)
}

/// °C of a wet bulb.
pub fn wet_bulb(celsius: f64, humidity: f64, millibars: f64) -> f64 {
    let vapour = vapour(celsius, humidity);
    let (mut low, mut high) = (-100.0, celsius);
    for _ in 0..40 {
        let middle = (low + high) / 2.0;
        // What evaporates from the bulb cools it below the air.
        if saturation(middle) - 0.000_662 * millibars * (celsius - middle) > vapour {
            high = middle;
        } else {
            low = middle;
        }
    }
    high
}

/// mbar at sea level, by the height of the place in metres.
pub fn at_sea_level(millibars: f64, metres: f64) -> f64 {
    millibars * libm::pow(1.0 - 0.0065 * metres / 288.15, -5.255)
}

/// m³/h by a difference of pressures and RWreg_24, the k-factor (pages 10 and 11).
///
/// The printed formulas have "∗ 1000" behind the k-factor. With the factory's 75 the register would be
/// full at a hundredth of a pascal; without it k is the factor that makers of fans give. A thousand is
/// between m³ and l, in Rreg_43 to 45, and taken to belong there.
pub fn flow_by_pressure(pascals: f64, k_factor: f64) -> f64 {
    let pascals = pascals.max(0.0);
    if k_factor < 1000.0 {
        // "Dichte der Luft angenommen mit 1,2 kg/m3".
        (pascals * 2.0 / 1.2).sqrt() * k_factor
    } else {
        // "1000 ... 1999 entspricht 1 ... 999": a thousand off, and 1000 itself is 0.
        pascals.sqrt() * (k_factor - 1000.0)
    }
}

/// m³/h by the speed in m/s and RWreg_48, the cross section in cm² (page 11).
pub fn flow_by_speed(speed: f64, square_centimetres: f64) -> f64 {
    speed * 3600.0 * square_centimetres / 10_000.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quantities_of_moist_air_are_those_of_the_tables_for_20_degrees_and_half_humid_air() {
        for (told, wanted) in [
            (absolute_humidity(20.0, 50.0), 8.63),
            (mixing_ratio(20.0, 50.0, 1013.0), 7.26),
            (dew_point(20.0, 50.0), 9.26),
            (wet_bulb(20.0, 50.0, 1013.0), 13.8),
            (wet_bulb(20.0, 100.0, 1013.0), 20.0),
            (at_sea_level(954.6, 500.0), 1013.2),
        ] {
            assert!((told - wanted).abs() < 0.06, "{told} {wanted}");
        }
        assert_eq!(dew_point(20.0, 0.0), f64::NEG_INFINITY);
        assert_eq!(mixing_ratio(150.0, 100.0, 1013.0), f64::INFINITY);
    }
}
