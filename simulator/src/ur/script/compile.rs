//! From a program's tree to code for the stack machine: names become slots, and functions and parameters are checked.
//!
//! Scopes follow UR's script manual ("Scoping rules"): `local` binds to the function and `global` to the program; a name without
//! either is looked for among the program's variables and is local otherwise. Variables of the program's own body count as
//! the program's. A function must be defined above its first use. Pure; allocates the code. A mistake is an error with its line.

use std::collections::BTreeMap;

use super::ScriptError;
use super::builtin::{self, BuiltinFunction};
use super::syntax::{Argument, Expr, ExprKind, Function, Operator, ProgramTree, Scope, Statement, StatementKind};
use super::value::Value;

/// Most instructions of a program. Chosen by hand; no measurement is recorded.
const MAX_OPS: usize = 200_000;
/// Most variables of the program itself. Chosen by hand; no measurement is recorded.
const MAX_GLOBALS: usize = 1024;
/// Most variables of one function. Chosen by hand; no measurement is recorded.
const MAX_LOCALS: usize = 128;

/// One instruction of the stack machine. A number is the slot of a variable, a count of operands, a routine, or the place that a
/// jump goes to.
#[derive(Debug, Clone)]
pub enum Op {
    Push(Value),
    Pop,
    LoadGlobal(usize),
    LoadLocal(usize),
    StoreGlobal(usize),
    StoreLocal(usize),
    /// Takes the value and, below it, the index from the stack.
    StoreGlobalElement(usize),
    /// Takes the value and, below it, the index from the stack.
    StoreLocalElement(usize),
    /// Makes a list of so many values.
    List(usize),
    /// Makes a pose of six values.
    Pose,
    Index,
    Not,
    Negative,
    Binary(Operator),
    Jump(usize),
    JumpIfFalse(usize),
    /// Leaves False on the stack and jumps, or takes True from the stack and goes on.
    And(usize),
    /// Leaves True on the stack and jumps, or takes False from the stack and goes on.
    Or(usize),
    /// Fails unless the top of the stack is a bool.
    CheckBool,
    Call(usize),
    Builtin(&'static BuiltinFunction),
    /// Starts a thread and leaves it on the stack.
    Run(usize),
    Join,
    Kill,
    Return,
    Halt,
    Pause,
}

impl Op {
    /// Whether it needs more than its own thread and the program's variables.
    pub fn needs_more(&self) -> bool {
        matches!(self, Op::Call(_) | Op::Builtin(_) | Op::Run(_) | Op::Join | Op::Kill | Op::Return | Op::Halt | Op::Pause)
    }
}

/// A function, a thread or, as routine 0, the program's own body.
#[derive(Debug, Clone)]
pub struct Routine {
    /// Place of the first instruction.
    pub entry: usize,
    /// Number of parameters.
    pub parameters: usize,
    /// Names of the local variables, parameters first.
    pub locals: Vec<String>,
}

/// A compiled program.
#[derive(Debug, Clone)]
pub struct Code {
    /// The instructions of all routines.
    pub ops: Vec<Op>,
    /// Source line of each instruction.
    pub lines: Vec<u32>,
    /// The routines; the program's own body is the first.
    pub routines: Vec<Routine>,
    /// Names of the program's variables.
    pub globals: Vec<String>,
}

/// Compiles a program.
///
/// # Errors
/// The program's first mistake, with its line.
pub fn compile(tree: &ProgramTree) -> Result<Code, ScriptError> {
    let mut globals = BTreeMap::new();
    collect_globals(&tree.body, true, &mut globals);
    if globals.len() > MAX_GLOBALS {
        return Err(ScriptError::new(1, format!("more than {MAX_GLOBALS} variables")));
    }
    let mut names = vec![String::new(); globals.len()];
    for (name, slot) in &globals {
        names[*slot] = name.clone();
    }
    let code = Code { ops: Vec::new(), lines: Vec::new(), routines: Vec::new(), globals: names };
    let mut compiler = Compiler { code, globals, functions: BTreeMap::new(), locals: Vec::new(), loops: Vec::new(), in_function: false };
    compiler.code.routines.push(Routine { entry: 0, parameters: 0, locals: Vec::new() });
    compiler.body(&tree.body)?;
    let last = tree.body.last().map_or(1, |s| s.line);
    compiler.emit(last, Op::Push(Value::None))?;
    compiler.emit(last, Op::Return)?;
    compiler.code.routines[0].locals = std::mem::take(&mut compiler.locals);
    Ok(compiler.code)
}

/// Collects the names that belong to the program: those after `global` anywhere, and those that its own body assigns without a
/// word before them.
fn collect_globals(body: &[Statement], own_body: bool, globals: &mut BTreeMap<String, usize>) {
    for statement in body {
        match &statement.kind {
            StatementKind::Assign { scope, name, .. } if *scope == Scope::Global || (own_body && *scope == Scope::Free) => {
                let next = globals.len();
                globals.entry(name.clone()).or_insert(next);
            }
            StatementKind::If { branches, otherwise } => {
                for (_, body) in branches {
                    collect_globals(body, own_body, globals);
                }
                collect_globals(otherwise, own_body, globals);
            }
            StatementKind::While { body, .. } => collect_globals(body, own_body, globals),
            StatementKind::Function(function) => collect_globals(&function.body, false, globals),
            _ => {}
        }
    }
}

/// A function or thread that is defined above.
#[derive(Clone)]
struct KnownFunction {
    routine: usize,
    parameters: Vec<(String, Option<Expr>)>,
    thread: bool,
}

/// A loop whose end is not compiled yet.
struct UnfinishedLoop {
    start: usize,
    /// Places of the jumps that go to its end.
    breaks: Vec<usize>,
}

struct Compiler {
    code: Code,
    /// Slots of the program's variables.
    globals: BTreeMap<String, usize>,
    functions: BTreeMap<String, KnownFunction>,
    /// Names of the variables of the function that is being compiled.
    locals: Vec<String>,
    loops: Vec<UnfinishedLoop>,
    in_function: bool,
}

impl Compiler {
    /// Appends an instruction and gives its place.
    fn emit(&mut self, line: u32, op: Op) -> Result<usize, ScriptError> {
        if self.code.ops.len() >= MAX_OPS {
            return Err(ScriptError::new(line, "program too long"));
        }
        self.code.ops.push(op);
        self.code.lines.push(line);
        Ok(self.code.ops.len() - 1)
    }

    fn here(&self) -> usize {
        self.code.ops.len()
    }

    /// Lets the jump at the place `at` go to the next instruction.
    fn land(&mut self, at: usize) {
        let here = self.here();
        match &mut self.code.ops[at] {
            Op::Jump(to) | Op::JumpIfFalse(to) | Op::And(to) | Op::Or(to) => *to = here,
            _ => {}
        }
    }

    fn body(&mut self, body: &[Statement]) -> Result<(), ScriptError> {
        body.iter().try_for_each(|s| self.statement(s))
    }

    fn local(&self, name: &str) -> Option<usize> {
        self.locals.iter().position(|l| l == name)
    }

    fn new_local(&mut self, line: u32, name: &str) -> Result<usize, ScriptError> {
        if self.locals.len() >= MAX_LOCALS {
            return Err(ScriptError::new(line, format!("more than {MAX_LOCALS} variables in one function")));
        }
        self.locals.push(name.to_owned());
        Ok(self.locals.len() - 1)
    }

    fn statement(&mut self, statement: &Statement) -> Result<(), ScriptError> {
        let line = statement.line;
        match &statement.kind {
            StatementKind::Assign { name, index: Some(index), value, .. } => self.assign_element(line, name, index, value)?,
            StatementKind::Assign { scope, name, index: None, value } => self.assign(line, *scope, name, value)?,
            StatementKind::Expr(expr) => {
                self.expr(expr)?;
                self.emit(line, Op::Pop)?;
            }
            StatementKind::If { branches, otherwise } => {
                let mut exits = Vec::new();
                for (condition, body) in branches {
                    self.expr(condition)?;
                    let skip = self.emit(condition.line, Op::JumpIfFalse(0))?;
                    self.body(body)?;
                    exits.push(self.emit(line, Op::Jump(0))?);
                    self.land(skip);
                }
                self.body(otherwise)?;
                exits.into_iter().for_each(|at| self.land(at));
            }
            StatementKind::While { condition, body } => {
                let start = self.here();
                self.expr(condition)?;
                let out = self.emit(condition.line, Op::JumpIfFalse(0))?;
                self.loops.push(UnfinishedLoop { start, breaks: vec![out] });
                self.body(body)?;
                self.emit(line, Op::Jump(start))?;
                if let Some(ended) = self.loops.pop() {
                    ended.breaks.into_iter().for_each(|at| self.land(at));
                }
            }
            StatementKind::Break | StatementKind::Continue => self.leave_or_repeat(line, statement.kind == StatementKind::Break)?,
            StatementKind::Return(value) => {
                if !self.in_function {
                    return Err(ScriptError::new(line, "'return' outside a function; 'halt' ends a program"));
                }
                self.expr(value)?;
                self.emit(line, Op::Return)?;
            }
            StatementKind::Halt => drop(self.emit(line, Op::Halt)?),
            StatementKind::Pause => drop(self.emit(line, Op::Pause)?),
            StatementKind::Join(thread) => {
                self.expr(thread)?;
                self.emit(line, Op::Join)?;
            }
            StatementKind::Kill(thread) => {
                self.expr(thread)?;
                self.emit(line, Op::Kill)?;
            }
            StatementKind::Function(function) => self.function(line, function)?,
        }
        Ok(())
    }

    fn assign(&mut self, line: u32, scope: Scope, name: &str, value: &Expr) -> Result<(), ScriptError> {
        self.expr(value)?;
        let store = match (scope, self.local(name), self.globals.get(name)) {
            (Scope::Global, _, Some(slot)) => Op::StoreGlobal(*slot),
            (_, Some(slot), _) => Op::StoreLocal(slot),
            (Scope::Free, None, Some(slot)) => Op::StoreGlobal(*slot),
            (_, None, _) => Op::StoreLocal(self.new_local(line, name)?),
        };
        self.emit(line, store)?;
        Ok(())
    }

    fn assign_element(&mut self, line: u32, name: &str, index: &Expr, value: &Expr) -> Result<(), ScriptError> {
        self.expr(index)?;
        self.expr(value)?;
        let store = match (self.local(name), self.globals.get(name)) {
            (Some(slot), _) => Op::StoreLocalElement(slot),
            (None, Some(slot)) => Op::StoreGlobalElement(*slot),
            (None, None) => return Err(ScriptError::new(line, format!("'{name}' has no value yet"))),
        };
        self.emit(line, store)?;
        Ok(())
    }

    /// Compiles `break` or, when `is_break` is false, `continue`.
    fn leave_or_repeat(&mut self, line: u32, is_break: bool) -> Result<(), ScriptError> {
        let jump = self.emit(line, Op::Jump(0))?;
        let Some(innermost) = self.loops.last_mut() else {
            return Err(ScriptError::new(line, if is_break { "'break' outside a loop" } else { "'continue' outside a loop" }));
        };
        if is_break {
            innermost.breaks.push(jump);
        } else {
            self.code.ops[jump] = Op::Jump(innermost.start);
        }
        Ok(())
    }

    fn function(&mut self, line: u32, function: &Function) -> Result<(), ScriptError> {
        let name = &function.name;
        if self.functions.contains_key(name) || builtin::find(name).is_some() {
            return Err(ScriptError::new(line, format!("there is already a function '{name}'")));
        }
        if function.thread && !function.parameters.is_empty() {
            return Err(ScriptError::new(line, format!("thread '{name}' takes no parameters")));
        }
        if function.parameters.len() > MAX_LOCALS {
            return Err(ScriptError::new(line, format!("more than {MAX_LOCALS} parameters")));
        }
        let mut optional = false;
        for (parameter, default) in &function.parameters {
            if default.as_ref().is_some_and(|d| !is_literal(d)) {
                return Err(ScriptError::new(line, format!("the default of parameter '{parameter}' must be a plain value")));
            }
            if optional && default.is_none() {
                return Err(ScriptError::new(line, format!("parameter '{parameter}' without a default follows one with a default")));
            }
            optional |= default.is_some();
        }
        let over = self.emit(line, Op::Jump(0))?;
        let routine = self.code.routines.len();
        self.code.routines.push(Routine { entry: self.here(), parameters: function.parameters.len(), locals: Vec::new() });
        self.functions.insert(name.clone(), KnownFunction { routine, parameters: function.parameters.clone(), thread: function.thread });
        let outer_locals = std::mem::replace(&mut self.locals, function.parameters.iter().map(|p| p.0.clone()).collect());
        let outer_loops = std::mem::take(&mut self.loops);
        let outer_in_function = std::mem::replace(&mut self.in_function, true);
        self.body(&function.body)?;
        self.emit(line, Op::Push(Value::None))?;
        self.emit(line, Op::Return)?;
        self.code.routines[routine].locals = std::mem::replace(&mut self.locals, outer_locals);
        self.loops = outer_loops;
        self.in_function = outer_in_function;
        self.land(over);
        Ok(())
    }

    fn expr(&mut self, expr: &Expr) -> Result<(), ScriptError> {
        let line = expr.line;
        let op = match &expr.kind {
            ExprKind::None => Op::Push(Value::None),
            ExprKind::Bool(value) => Op::Push(Value::Bool(*value)),
            ExprKind::Int(value) => Op::Push(Value::Int(*value)),
            ExprKind::Float(value) => Op::Push(Value::Float(*value)),
            ExprKind::Str(text) => Op::Push(Value::text(text).map_err(|e| ScriptError::new(line, e))?),
            ExprKind::List(items) => {
                items.iter().try_for_each(|i| self.expr(i))?;
                Op::List(items.len())
            }
            ExprKind::Pose(items) => {
                if items.len() != 6 {
                    return Err(ScriptError::new(line, format!("a pose has 6 numbers, not {}", items.len())));
                }
                items.iter().try_for_each(|i| self.expr(i))?;
                Op::Pose
            }
            ExprKind::Name(name) => match (self.local(name), self.globals.get(name)) {
                (Some(slot), _) => Op::LoadLocal(slot),
                (None, Some(slot)) => Op::LoadGlobal(*slot),
                (None, None) => return Err(ScriptError::new(line, format!("unknown name '{name}'"))),
            },
            ExprKind::Index(list, index) => {
                self.expr(list)?;
                self.expr(index)?;
                Op::Index
            }
            ExprKind::Not(inner) => {
                self.expr(inner)?;
                Op::Not
            }
            ExprKind::Negative(inner) => {
                self.expr(inner)?;
                Op::Negative
            }
            ExprKind::Binary(operator, a, b) => {
                self.expr(a)?;
                self.expr(b)?;
                Op::Binary(*operator)
            }
            ExprKind::And(a, b) => return self.short_circuit(line, Op::And(0), a, b),
            ExprKind::Or(a, b) => return self.short_circuit(line, Op::Or(0), a, b),
            ExprKind::Call(name, arguments) => self.call(line, name, arguments)?,
            ExprKind::Run(name, arguments) => self.run(line, name, arguments)?,
        };
        self.emit(line, op)?;
        Ok(())
    }

    /// Compiles `and` or `or`: the jump `short` passes over the second operand when the first one decides.
    fn short_circuit(&mut self, line: u32, short: Op, a: &Expr, b: &Expr) -> Result<(), ScriptError> {
        self.expr(a)?;
        let jump = self.emit(line, short)?;
        self.expr(b)?;
        self.emit(line, Op::CheckBool)?;
        self.land(jump);
        Ok(())
    }

    fn run(&self, line: u32, name: &str, arguments: &[Argument]) -> Result<Op, ScriptError> {
        let Some(known) = self.functions.get(name).filter(|k| k.thread) else {
            return Err(ScriptError::new(line, format!("no thread '{name}' is defined above")));
        };
        if !arguments.is_empty() {
            return Err(ScriptError::new(line, format!("thread '{name}' takes no parameters")));
        }
        Ok(Op::Run(known.routine))
    }

    /// Compiles the arguments and gives the instruction that calls the function.
    fn call(&mut self, line: u32, name: &str, arguments: &[Argument]) -> Result<Op, ScriptError> {
        if let Some(function) = builtin::find(name) {
            let places = arrange(line, name, function.parameters, arguments)?;
            for (i, given) in places.iter().enumerate() {
                match given {
                    Some(value) => self.expr(value)?,
                    None if i < function.required => {
                        return Err(ScriptError::new(line, format!("{name}: parameter '{}' is missing", function.parameters[i])));
                    }
                    None => drop(self.emit(line, Op::Push(Value::None))?),
                }
            }
            return Ok(Op::Builtin(function));
        }
        let Some(known) = self.functions.get(name).cloned() else {
            return Err(ScriptError::new(line, format!("no function '{name}' is defined above or built in{}", builtin::hint(name))));
        };
        if known.thread {
            return Err(ScriptError::new(line, format!("thread '{name}' is started with 'run {name}()'")));
        }
        let names: Vec<&str> = known.parameters.iter().map(|p| p.0.as_str()).collect();
        let places = arrange(line, name, &names, arguments)?;
        for (given, (parameter, default)) in places.iter().zip(&known.parameters) {
            match (given, default) {
                (Some(value), _) => self.expr(value)?,
                (None, Some(default)) => self.expr(default)?,
                (None, None) => return Err(ScriptError::new(line, format!("{name}: parameter '{parameter}' is missing"))),
            }
        }
        Ok(Op::Call(known.routine))
    }
}

/// The arguments in the order of the parameters; None for each that is not given.
fn arrange<'a>(line: u32, name: &str, parameters: &[&str], arguments: &'a [Argument]) -> Result<Vec<Option<&'a Expr>>, ScriptError> {
    let mut places = vec![None; parameters.len()];
    for (i, (given_name, value)) in arguments.iter().enumerate() {
        let at = match given_name {
            None => i,
            Some(given) => parameters.iter().position(|p| p == given).ok_or_else(|| {
                ScriptError::new(line, format!("{name} has no parameter '{given}'; it takes ({})", parameters.join(", ")))
            })?,
        };
        let Some(free) = places.get_mut(at) else {
            return Err(ScriptError::new(line, format!("{name} takes {} parameters, {} given", parameters.len(), arguments.len())));
        };
        if free.replace(value).is_some() {
            return Err(ScriptError::new(line, format!("{name}: parameter '{}' is given twice", parameters[at])));
        }
    }
    Ok(places)
}

fn is_literal(expr: &Expr) -> bool {
    match &expr.kind {
        ExprKind::None | ExprKind::Bool(_) | ExprKind::Int(_) | ExprKind::Float(_) | ExprKind::Str(_) => true,
        ExprKind::Negative(inner) => is_literal(inner),
        ExprKind::List(items) | ExprKind::Pose(items) => items.iter().all(is_literal),
        _ => false,
    }
}
