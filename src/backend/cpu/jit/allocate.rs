//! Registers for straight-line code: what is needed furthest in the future goes to memory (Belady
//! 1966).

use super::encoder::{Base, Encoder, Form, Mask, Operand, Register};
use crate::backend::cpu::code::{Binary, Fused, Op, Value};
use rustc_hash::FxHashMap;

const NEVER: u32 = u32::MAX;

/// Machine code and what it needs.
pub struct Assembled {
    pub bytes: Vec<u8>,
    /// Bits of the constants behind the parameters.
    pub pool: Vec<u64>,
    pub spills: usize,
}

/// Where values lie in memory.
#[derive(Clone, Copy)]
pub struct Layout {
    /// Bytes from one slot of the frame to the next.
    pub stride: usize,
    /// Neighbouring vectors side by side.
    pub copies: u32,
    /// Parameters in front of the constants.
    pub parameters: usize,
}

struct Allocator<'a, E> {
    ops: &'a [Op],
    layout: Layout,
    asm: E,
    /// Reads of each value, latest first.
    uses: Vec<Vec<u32>>,
    register: Vec<Option<Register>>,
    held: Vec<Option<Value>>,
    /// When each register's value is needed next.
    needed: Vec<u32>,
    /// The mask registers that comparisons are in which only blends read, and soon.
    mask: Vec<Option<Mask>>,
    next_mask: Mask,
    /// Where a value can be read again.
    memory: Vec<Option<(Base, i32)>>,
    free_spills: Vec<i32>,
    /// Places of values that have ended in the operation at hand, which may still read them.
    ended: Vec<i32>,
    spills: usize,
    pool: FxHashMap<u64, i32>,
    patterns: Vec<u64>,
}

/// Assembles code that works through groups of vectors (see [`Encoder::repeat`]).
pub fn assemble(ops: &[Op], layout: Layout, asm: impl Encoder) -> Assembled {
    let mut uses = vec![Vec::new(); ops.len()];
    for (i, op) in ops.iter().enumerate().rev() {
        op.reads().for_each(|v| uses[v as usize].push(i as u32));
    }
    let mut this = Allocator {
        ops,
        layout,
        uses,
        register: vec![None; ops.len()],
        held: vec![None; asm.registers()],
        needed: vec![NEVER; asm.registers()],
        asm,
        mask: vec![None; ops.len()],
        next_mask: 0,
        memory: vec![None; ops.len()],
        free_spills: Vec::new(),
        ended: Vec::new(),
        spills: 0,
        pool: FxHashMap::default(),
        patterns: Vec::new(),
    };
    for i in 0..ops.len() {
        this.emit(i);
    }
    let moved = layout.copies as usize * this.vector();
    Assembled {
        bytes: this.asm.repeat(moved),
        pool: this.patterns,
        spills: this.spills,
    }
}

impl<E: Encoder> Allocator<'_, E> {
    fn frame(&self, slot: u32) -> i32 {
        let (slot, copy) = (slot / self.layout.copies, slot % self.layout.copies);
        (slot as usize * self.layout.stride + copy as usize * self.vector()) as i32
    }

    fn vector(&self) -> usize {
        self.asm.vector()
    }

    /// Whether a comparison can stay in a mask register: blends alone read it, as what they choose
    /// by, and its register is not needed again before.
    fn stays_mask(&self, i: usize) -> bool {
        let chooses = |u: &u32| match self.ops[*u as usize] {
            Op::Blend(mask, yes, no) => {
                let v = i as Value;
                mask == v && yes != v && no != v
            }
            _ => false,
        };
        let reads = &self.uses[i];
        let Some(last) = reads.first() else {
            return false;
        };
        let compares = |op: &&Op| matches!(op, Op::Binary(Binary::Compare(_), ..));
        let masks = usize::from(self.asm.masks());
        masks > 0
            && reads.iter().all(chooses)
            && self.ops[i + 1..*last as usize]
                .iter()
                .filter(compares)
                .count()
                < masks
    }

    fn next_use(&self, v: Value) -> u32 {
        self.uses[v as usize].last().copied().unwrap_or(NEVER)
    }

    fn emit(&mut self, i: usize) {
        let op = self.ops[i];
        self.free_spills.append(&mut self.ended);
        match op {
            Op::Load(slot) => self.memory[i] = Some((Base::Frame, self.frame(slot))),
            Op::Parameter(p) => {
                self.memory[i] = Some((Base::Pool, (p as usize * self.vector()) as i32))
            }
            Op::Pattern(bits) => {
                let next = (self.layout.parameters + self.patterns.len()) * self.vector();
                let at = *self.pool.entry(bits).or_insert_with(|| {
                    self.patterns.push(bits);
                    next as i32
                });
                self.memory[i] = Some((Base::Pool, at));
            }
            Op::Store(v, slot) => {
                let r = self.bring(v, &[]);
                let at = self.frame(slot);
                self.asm.store(r, Base::Frame, at);
                // From now on the value can be read from there.
                if self.memory[v as usize].is_none() {
                    self.memory[v as usize] = Some((Base::Frame, at));
                }
                self.used(&[v]);
            }
            Op::Binary(kind, a, b) => {
                let in_memory = |v: Value| self.register[v as usize].is_none();
                let (a, b) = if kind.commutes() && in_memory(a) && !in_memory(b) {
                    (b, a)
                } else {
                    (a, b)
                };
                let ra = self.bring(a, &[b]);
                let ob = self.operand(b, &[a]);
                self.used(&[a, b]);
                match kind {
                    Binary::Compare(how) if self.stays_mask(i) => {
                        self.next_mask = self.next_mask % self.asm.masks() + 1;
                        self.mask[i] = Some(self.next_mask);
                        self.asm.compare(how, self.next_mask, ra, ob);
                    }
                    _ => {
                        let to = self.fresh(&[], i);
                        self.asm.binary(kind, to, ra, ob);
                    }
                }
            }
            Op::Sqrt(a) => {
                let oa = self.operand(a, &[]);
                self.used(&[a]);
                let to = self.fresh(&[], i);
                self.asm.sqrt(to, oa);
            }
            Op::ShiftLeft(a, by) | Op::ShiftRight(a, by) => {
                let ra = self.bring(a, &[]);
                self.used(&[a]);
                let to = self.fresh(&[], i);
                self.asm.shift(matches!(op, Op::ShiftLeft(..)), to, ra, by);
            }
            Op::Blend(mask, yes, no) if self.mask[mask as usize].is_some() => {
                let k = self.mask[mask as usize].unwrap_or_default();
                let rn = self.bring(no, &[yes]);
                let oy = self.operand(yes, &[no]);
                self.used(&[mask, yes, no]);
                let to = self.fresh(&[], i);
                self.asm.choose(to, k, oy, rn);
            }
            Op::Blend(mask, yes, no) => {
                let rm = self.bring(mask, &[yes, no]);
                let rn = self.bring(no, &[mask, yes]);
                let oy = self.operand(yes, &[mask, no]);
                self.used(&[mask, yes, no]);
                let to = self.fresh(&[], i);
                self.asm.blend(to, rm, oy, rn);
            }
            Op::Fused(kind, a, b, c) => self.fused(i, kind, a, b, c),
            Op::Call(f, _) => unreachable!("{f:?} was not expanded"),
        }
    }

    /// The result replaces one operand, and at most one is read from memory.
    fn fused(&mut self, i: usize, kind: Fused, a: Value, b: Value, c: Value) {
        let all = [a, b, c];
        let inside = |this: &Self, v: Value| this.register[v as usize].is_some();
        let dies = |this: &Self, v: Value| this.uses[v as usize].iter().all(|u| *u == i as u32);
        // Prefer to replace a value that ends here and is in a register; else one to be loaded for
        // this alone.
        let replaced = (all.iter().position(|v| inside(self, *v) && dies(self, *v)))
            .or_else(|| all.iter().position(|v| !inside(self, *v)));
        let rest = |k: usize| {
            all.iter()
                .enumerate()
                .filter(move |(j, _)| *j != k)
                .map(|(_, v)| *v)
        };
        let k = match replaced {
            Some(k) if !self.asm.only_accumulates() => k,
            _ => 2,
        };
        let others: Vec<Value> = rest(k).collect();
        // The other operand that stays in memory.
        let last = (others.iter().position(|v| !inside(self, *v))).unwrap_or(1);
        let (m, v) = (others[last], others[1 - last]);
        let rv = self.bring(v, &all);
        let om = if m == v {
            Operand::Register(rv)
        } else {
            self.operand(m, &all)
        };
        let d = all[k];
        let to = if let Some(r) = self.register[d as usize] {
            let ends = dies(self, d) && !others.contains(&d);
            self.used(&all);
            if ends {
                self.take(r, i);
                r
            } else {
                // The copy must not replace an operand that ends here.
                let busy: Vec<Register> = [Some(r), Some(rv), register_of(om)]
                    .into_iter()
                    .flatten()
                    .collect();
                let to = self.fresh(&busy, i);
                self.asm.copy(to, Operand::Register(r));
                to
            }
        } else {
            let from = self.home(d);
            let busy: Vec<Register> = [Some(rv), register_of(om)].into_iter().flatten().collect();
            // Its register is taken before the operands end, or it could be theirs.
            let to = self.room(&busy);
            self.asm.copy(to, from);
            self.used(&all);
            self.take(to, i);
            to
        };
        // Products commute, so of the three forms one fits each case.
        let form = match (k, m == c) {
            (2, _) => Form::F231,
            (_, true) => Form::F213,
            (_, false) => Form::F132,
        };
        self.asm.fused(kind, form, to, rv, om);
    }

    /// A register with the value; the registers of `keep` stay.
    fn bring(&mut self, v: Value, keep: &[Value]) -> Register {
        if let Some(r) = self.register[v as usize] {
            return r;
        }
        let busy: Vec<Register> = keep
            .iter()
            .filter_map(|k| self.register[*k as usize])
            .collect();
        let r = self.room(&busy);
        let from = self.home(v);
        self.asm.copy(r, from);
        self.held[r as usize] = Some(v);
        self.needed[r as usize] = self.next_use(v);
        self.register[v as usize] = Some(r);
        r
    }

    /// The value where it is, or in a register where it will be read again soon.
    fn operand(&mut self, v: Value, keep: &[Value]) -> Operand {
        if let Some(r) = self.register[v as usize] {
            return Operand::Register(r);
        }
        let again = self.uses[v as usize]
            .iter()
            .rev()
            .nth(1)
            .copied()
            .unwrap_or(NEVER);
        let worth = again != NEVER && {
            let busy: Vec<Register> = keep
                .iter()
                .filter_map(|k| self.register[*k as usize])
                .collect();
            let (_, next) = self.victim(&busy);
            // A longer wait than the one evicted would have is not worth a load.
            next > again
        };
        if worth {
            Operand::Register(self.bring(v, keep))
        } else {
            self.home(v)
        }
    }

    /// Where a value that is in no register lies.
    fn home(&self, v: Value) -> Operand {
        match self.memory[v as usize] {
            Some((base, offset)) => Operand::Memory(base, offset),
            None => unreachable!("value {v} is neither in a register nor in memory"),
        }
    }

    /// The register whose value is needed last, free ones first, and when that is.
    fn victim(&self, busy: &[Register]) -> (Register, u32) {
        let mut best: Option<(Register, u32)> = None;
        for (r, next) in self.needed.iter().enumerate() {
            let (r, next) = (r as Register, *next);
            if busy.contains(&r) {
                continue;
            }
            if best.is_none_or(|(_, n)| next > n) {
                best = Some((r, next));
            }
        }
        best.unwrap_or((0, 0))
    }

    /// An empty register; its value goes to memory where it is needed again.
    fn room(&mut self, busy: &[Register]) -> Register {
        let (r, _) = self.victim(busy);
        if let Some(v) = self.held[r as usize].take() {
            self.needed[r as usize] = NEVER;
            self.register[v as usize] = None;
            if self.next_use(v) != NEVER && self.memory[v as usize].is_none() {
                let vector = self.vector();
                let at = self.free_spills.pop().unwrap_or_else(|| {
                    self.spills += 1;
                    ((self.spills - 1) * vector) as i32
                });
                self.asm.store(r, Base::Spill, at);
                self.memory[v as usize] = Some((Base::Spill, at));
            }
        }
        r
    }

    /// A register for the result of operation `i`.
    fn fresh(&mut self, busy: &[Register], i: usize) -> Register {
        let r = self.room(busy);
        self.take(r, i);
        r
    }

    fn take(&mut self, r: Register, i: usize) {
        self.held[r as usize] = Some(i as Value);
        self.needed[r as usize] = self.next_use(i as Value);
        self.register[i] = Some(r);
    }

    /// The operation at hand has read these values; those not needed again give up their places.
    fn used(&mut self, values: &[Value]) {
        for &v in values {
            self.uses[v as usize].pop();
            if let Some(r) = self.register[v as usize] {
                self.needed[r as usize] = self.next_use(v);
            }
            if self.next_use(v) == NEVER {
                if let Some(r) = self.register[v as usize].take() {
                    self.held[r as usize] = None;
                }
                if let Some((Base::Spill, at)) = self.memory[v as usize].take() {
                    self.ended.push(at);
                }
            }
        }
    }
}

fn register_of(operand: Operand) -> Option<Register> {
    match operand {
        Operand::Register(r) => Some(r),
        Operand::Memory(..) => None,
    }
}
