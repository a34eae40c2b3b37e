//! Constants of the elementary functions, shared by the CPU lanes and the shaders.
//!
//! Polynomials are those of fdlibm (f64) and Cephes / musl (f32), public-domain minimax
//! approximations; highest coefficient first.

use crate::model::Precision;

/// Constants of one precision, by name, for backends that generate code.
pub struct Constants {
    /// pi/2 in parts: products of the leading ones with small integers are exact.
    pub pio2: [f64; 3],
    /// log 2 in two parts, likewise.
    pub ln2: [f64; 2],
    /// Largest argument of a finite exponential, and the smallest of one that is not zero.
    pub overflow: f64,
    pub underflow: f64,
    /// The polynomials, with the names of the functions they belong to.
    pub polynomials: [(&'static str, &'static [f64]); 5],
}

impl Constants {
    pub fn of(precision: Precision) -> Self {
        macro_rules! constants {
            ($m:ident) => {
                Constants {
                    pio2: $m::PIO2,
                    ln2: $m::LN2,
                    overflow: $m::OVERFLOW,
                    underflow: $m::UNDERFLOW,
                    polynomials: [
                        ("sin", &$m::SIN),
                        ("cos", &$m::COS),
                        ("exp", &$m::EXP),
                        ("log", &$m::LOG),
                        ("atan", &$m::ATAN),
                    ],
                }
            };
        }
        match precision {
            Precision::F32 => constants!(single),
            Precision::F64 => constants!(double),
        }
    }
}

/// For f64.
pub mod double {
    pub const PIO2: [f64; 3] = [
        1.570_796_326_734_125_614_17,
        6.077_100_506_303_965_976_60e-11,
        2.022_266_248_795_950_631_54e-21,
    ];
    pub const SIN: [f64; 6] = [
        1.589_690_995_211_550_102_21e-10,
        -2.505_076_025_340_686_341_95e-08,
        2.755_731_370_707_006_767_89e-06,
        -1.984_126_982_985_794_931_34e-04,
        8.333_333_333_322_489_461_24e-03,
        -1.666_666_666_666_663_243_48e-01,
    ];
    pub const COS: [f64; 6] = [
        -1.135_964_755_778_819_482_65e-11,
        2.087_572_321_298_174_827_90e-09,
        -2.755_731_435_139_066_330_35e-07,
        2.480_158_728_947_672_941_78e-05,
        -1.388_888_888_887_410_957_49e-03,
        4.166_666_666_666_660_190_37e-02,
    ];
    pub const LN2: [f64; 2] = [
        6.931_471_803_691_238_164_90e-01,
        1.908_214_929_270_587_700_02e-10,
    ];
    /// Taylor: on |r| <= log(2)/2 the next term is below 1e-17.
    pub const EXP: [f64; 12] = [
        1.0 / 6_227_020_800.0,
        1.0 / 479_001_600.0,
        1.0 / 39_916_800.0,
        1.0 / 3_628_800.0,
        1.0 / 362_880.0,
        1.0 / 40_320.0,
        1.0 / 5_040.0,
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
    ];
    pub const OVERFLOW: f64 = 709.782_712_893_383_973_096;
    pub const UNDERFLOW: f64 = -745.133_219_101_941_108_420;
    pub const LOG: [f64; 7] = [
        1.479_819_860_511_658_591e-01,
        1.531_383_769_920_937_332e-01,
        1.818_357_216_161_805_012e-01,
        2.222_219_843_214_978_396e-01,
        2.857_142_874_366_239_149e-01,
        3.999_999_999_940_941_908e-01,
        6.666_666_666_666_735_130e-01,
    ];
    pub const ATAN: [f64; 11] = [
        1.628_582_011_536_578_236_23e-02,
        -3.653_157_274_421_691_552_70e-02,
        4.976_877_994_615_932_360_17e-02,
        -5.833_570_133_790_573_486_45e-02,
        6.661_073_137_387_531_206_69e-02,
        -7.691_876_205_044_829_994_95e-02,
        9.090_887_133_436_506_561_96e-02,
        -1.111_111_040_546_235_578_80e-01,
        1.428_571_427_250_346_637_11e-01,
        -1.999_999_999_987_648_324_76e-01,
        3.333_333_333_333_293_180_27e-01,
    ];
}

/// For f32.
pub mod single {
    pub const PIO2: [f64; 3] = [
        1.570_312_5,
        4.837_512_969_970_703e-4,
        7.549_789_954_891_882e-8,
    ];
    pub const SIN: [f64; 3] = [-1.951_529_589_1e-4, 8.332_160_873_6e-3, -1.666_665_461_1e-1];
    pub const COS: [f64; 3] = [
        2.443_315_711_809_948e-5,
        -1.388_731_625_493_765e-3,
        4.166_664_568_298_827e-2,
    ];
    pub const LN2: [f64; 2] = [6.933_593_75e-1, -2.121_944_400_546_906e-4];
    pub const EXP: [f64; 6] = [
        1.0 / 5_040.0,
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
    ];
    pub const OVERFLOW: f64 = 88.722_84;
    pub const UNDERFLOW: f64 = -103.972_08;
    pub const LOG: [f64; 4] = [
        0.242_790_788_41,
        0.284_987_866_88,
        0.400_009_721_52,
        0.666_666_626_93,
    ];
    pub const ATAN: [f64; 5] = [
        6.168_760_731_8e-2,
        -1.064_801_737_7e-1,
        1.425_363_570_5e-1,
        -1.999_915_838_2e-1,
        3.333_332_836_6e-1,
    ];
}
