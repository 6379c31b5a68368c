//! The rules of RTDE: recipes, versions, types, ownership of inputs, and clients that do not read.

use std::collections::BTreeMap;
use std::io::{ErrorKind, Read, Write};

use simulator::ur::{Controller, ControllerOptions, Series, Version};

use crate::client::{RtdeClient, hex, int};
use crate::{COUNT, RECEIVE, connect, playing, start, until};

// Protects ur_rtde's IO interface: inputs work on a connection that was never started and never asked for outputs. As on a robot,
// START is refused there.
#[test]
fn inputs_work_without_outputs_and_start() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::new(address);
    client.ask(b'V', &[0, 2]);
    for id in 1..=3 {
        assert_eq!(client.inputs(&format!("input_int_register_2{id}")), format!("{id}:INT32"));
    }
    assert_eq!(client.inputs("speed_slider_mask,speed_slider_fraction,"), "4:UINT32,DOUBLE");
    assert_eq!(client.inputs("standard_digital_output_mask,standard_digital_output"), "5:UINT8,UINT8");
    client.stream.write_all(&hex("0010 55 04 00000001 3fe0000000000000")).unwrap();
    client.stream.write_all(&hex("0006 55 05 04 04")).unwrap();
    let mut reader = RtdeClient::started(address, "target_speed_fraction,target_speed_fraction,actual_digital_output_bits");
    until("slider at a half and output 2 on", || reader.data() == hex("3fe0000000000000 3fe0000000000000 0000000000000004"));
    assert_eq!(client.ask(b'S', &[]), hex("00045300"));
    assert_eq!(client.ask(b'P', &[]), hex("00045001"));
}

// Protects protocol version 1, which a session has before it negotiates: there is no frequency, and no recipe id in answers and data.
#[test]
fn version_1_has_no_recipe_id_for_outputs() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::new(address);
    let answer = client.ask(b'O', b"timestamp,robot_mode");
    assert_eq!(&answer[3..], b"DOUBLE,INT32");
    client.ask(b'S', &[]);
    let packet = client.answer(b'U');
    assert_eq!((packet.len(), int(&packet, 11)), (3 + 12, 7));
    assert_eq!(client.ask(b'V', &[0, 7]), hex("00045600"), "no version 7; the session goes on");
    assert_eq!(client.ask(b'V', &[0, 1]), hex("00045601"));
}

// Protects recipes: a second O replaces the first and stops the stream, P stops it and always answers 1, and S lets it go on.
#[test]
fn outputs_are_replaced_paused_and_resumed() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "timestamp");
    assert_eq!(client.data().len(), 8);
    assert_eq!(client.outputs(125.0, "robot_mode,safety_mode,"), "2:INT32,INT32");
    client.ask(b'S', &[]);
    let packet = client.answer(b'U');
    assert_eq!((packet[3], int(&packet, 4), int(&packet, 8)), (2, 7, 1));
    assert_eq!(client.ask(b'P', &[]), hex("00045001"));
    client.send(b'v', &[]);
    assert_eq!(client.packet().unwrap().unwrap()[2], b'v', "no data after the answer to PAUSE");
    client.ask(b'S', &[]);
    client.data();
}

// Protects refusals: an unknown variable is NOT_FOUND, its recipe has the id 0, and nothing can be started with such a recipe.
#[test]
fn unknown_variables_make_a_recipe_invalid() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::new(address);
    client.ask(b'V', &[0, 2]);
    assert_eq!(client.outputs(125.0, "timestamp,no_such_thing"), "0:DOUBLE,NOT_FOUND");
    assert_eq!(client.ask(b'S', &[]), hex("00045300"));
    assert_eq!(client.inputs("input_int_register_24,input_int_register_48"), "0:INT32,NOT_FOUND");
    assert_eq!(client.inputs("input_int_register_24"), "1:INT32", "an invalid recipe takes no id");
    assert_eq!(client.outputs(0.0, "timestamp"), "0:DOUBLE", "a frequency below 1 Hz");
    // Data for a recipe that does not exist, or of a wrong length, is answered by a text message and changes nothing.
    client.stream.write_all(&hex("000855090000000b")).unwrap();
    assert_eq!(client.packet().unwrap().unwrap()[2], b'M');
    client.stream.write_all(&hex("00055501ff")).unwrap();
    assert_eq!(client.packet().unwrap().unwrap()[2], b'M');
    let mut reader = RtdeClient::started(address, "input_int_register_24");
    assert_eq!(int(&reader.data(), 0), 0);
}

// Protects the table of variables: every variable has the type and the size of UR's RTDE guide, and newer ones are unknown to older
// controllers.
#[test]
fn every_variable_has_its_type_and_size() {
    let sizes = BTreeMap::from([
        ("BOOL", 1),
        ("UINT8", 1),
        ("INT32", 4),
        ("UINT32", 4),
        ("UINT64", 8),
        ("DOUBLE", 8),
        ("VECTOR3D", 24),
        ("VECTOR6D", 48),
        ("VECTOR6INT32", 24),
    ]);
    let table = [
        (
            "DOUBLE",
            "timestamp,speed_scaling,target_speed_fraction,actual_momentum,actual_main_voltage,actual_robot_voltage,\
          actual_robot_current,actual_execution_time,standard_analog_input0,standard_analog_input1,standard_analog_output0,\
          standard_analog_output1,payload,output_double_register_0,output_double_register_47,input_double_register_0,\
          input_double_register_47",
        ),
        (
            "VECTOR6D",
            "target_q,target_qd,target_qdd,target_current,target_moment,actual_q,actual_qd,actual_current,\
          joint_control_output,actual_TCP_pose,actual_TCP_speed,actual_TCP_force,target_TCP_pose,target_TCP_speed,joint_temperatures,\
          actual_joint_voltage,payload_inertia",
        ),
        ("VECTOR6INT32", "joint_mode"),
        ("VECTOR3D", "actual_tool_accelerometer,payload_cog,elbow_position,elbow_velocity"),
        ("UINT64", "actual_digital_input_bits,actual_digital_output_bits"),
        (
            "INT32",
            "robot_mode,safety_mode,safety_status,output_int_register_0,output_int_register_47,input_int_register_0,\
          input_int_register_47",
        ),
        (
            "UINT32",
            "runtime_state,robot_status_bits,safety_status_bits,script_control_line,output_bit_registers0_to_31,\
          output_bit_registers32_to_63,input_bit_registers0_to_31,input_bit_registers32_to_63",
        ),
        ("BOOL", "output_bit_register_64,output_bit_register_127,input_bit_register_64,input_bit_register_127"),
    ];
    let inputs = [
        ("INT32", "input_int_register_0,input_int_register_47"),
        (
            "DOUBLE",
            "input_double_register_0,input_double_register_47,speed_slider_fraction,standard_analog_output_0,\
          standard_analog_output_1",
        ),
        ("BOOL", "input_bit_register_64,input_bit_register_127"),
        ("UINT32", "input_bit_registers0_to_31,input_bit_registers32_to_63,speed_slider_mask"),
        (
            "UINT8",
            "standard_digital_output_mask,standard_digital_output,configurable_digital_output_mask,\
          configurable_digital_output,tool_digital_output_mask,tool_digital_output,standard_analog_output_mask,\
          standard_analog_output_type",
        ),
        ("VECTOR6D", "external_force_torque"),
    ];
    let (_handle, address) = start(Series::Cb3);
    for (kind, names) in table {
        let mut client = RtdeClient::new(address);
        client.ask(b'V', &[0, 2]);
        let count = names.split(',').count();
        assert_eq!(client.outputs(125.0, names), format!("1:{}", vec![kind; count].join(",")));
        client.ask(b'S', &[]);
        assert_eq!(client.data().len(), count * sizes[kind], "{names}");
    }
    for (kind, names) in inputs {
        let mut client = RtdeClient::new(address);
        client.ask(b'V', &[0, 2]);
        assert_eq!(client.inputs(names), format!("1:{}", vec![kind; names.split(',').count()].join(",")));
    }
    let types_on = |series, version, names: &str| {
        let mut options = ControllerOptions::new(crate::address());
        options.series = series;
        options.version = version;
        let at = options.address;
        let _handle = Controller::start(options).unwrap();
        let mut client = RtdeClient::new(at);
        client.ask(b'V', &[0, 2]);
        client.outputs(125.0, names)
    };
    let newer = "safety_status,payload,payload_inertia,script_control_line,ft_raw_wrench,output_int_register_24";
    assert_eq!(types_on(Series::Cb3, None, newer), "0:INT32,DOUBLE,VECTOR6D,UINT32,NOT_FOUND,INT32");
    assert_eq!(types_on(Series::ESeries, None, newer), "1:INT32,DOUBLE,VECTOR6D,UINT32,VECTOR6D,INT32");
    let old = Some(Version { major: 3, minor: 8, bugfix: 0, build: 1 });
    assert_eq!(types_on(Series::Cb3, old, newer), format!("0:{}", ["NOT_FOUND"; 6].join(",")));
}

// Protects ownership: a variable has one writer among all connections, which may use it in several recipes and releases it when it leaves.
#[test]
fn one_client_owns_a_variable_until_it_leaves() {
    let (_handle, address) = start(Series::Cb3);
    let mut first = RtdeClient::new(address);
    assert_eq!(first.inputs("input_int_register_24"), "1:INT32");
    assert_eq!(first.inputs("input_int_register_24,input_int_register_25"), "2:INT32,INT32");
    let mut second = RtdeClient::new(address);
    assert_eq!(second.inputs("input_int_register_26,input_int_register_25"), "0:INT32,IN_USE");
    let mut third = RtdeClient::new(address);
    assert_eq!(third.inputs("input_int_register_26"), "1:INT32", "a refused recipe claims nothing");
    drop(first);
    until("ownership released", || second.inputs("input_int_register_24,input_int_register_25") != "0:IN_USE,IN_USE");
}

// Protects the other clients from one that does not read: it is closed, and they are served without a gap. On port 30003, which
// ur_rtde never reads, packages are left out instead and the connection stays.
#[test]
fn a_client_that_does_not_read_is_closed_and_others_are_not() {
    let (handle, address) = start(Series::ESeries);
    let lazy = RtdeClient::started(address, RECEIVE);
    let mut lazy_script = connect(address, 30003);
    let mut reader = RtdeClient::started(address, "timestamp,actual_q");
    until("both connected", || handle.state().unwrap().rtde_clients == 2);
    until("the lazy one gone", || {
        reader.data();
        handle.state().unwrap().rtde_clients == 1
    });
    reader.data();
    let mut rest = lazy.stream.try_clone().unwrap();
    let mut sink = Vec::new();
    // What the kernel had taken can still be read, and then the connection ends.
    match rest.read_to_end(&mut sink) {
        Ok(_) => {}
        Err(e) => assert_eq!(e.kind(), ErrorKind::ConnectionReset),
    }
    lazy_script.write_all(COUNT.as_bytes()).unwrap();
    playing(&handle);
}
