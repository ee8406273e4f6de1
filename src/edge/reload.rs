//! A new configuration while the gateway runs: only what has changed ends, begins or begins anew.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::Context;

use crate::edge::app::{
    App, BUSES_END_WITHIN, Keys, connect, end_buses, introduce, remember_topics, start_bus, watch, watched,
};
use crate::edge::bus_thread::BusHandle;
use crate::edge::http::{Bound, Http};
use crate::edge::mqtt::Mailbox;
use crate::edge::plant;
use crate::edge::reports::Reporter;
use crate::edge::secrets::Secrets;
use crate::edge::state_files::StateFiles;
use crate::engine::bus::{self, Bus, Event};
use crate::engine::homeassistant;
use crate::engine::outbox::Outbox;
use crate::engine::profile::Library;
use crate::engine::reload::{self, Change, Circumstances, Telling};
use crate::engine::settings::Settings;
use crate::engine::time::Duration;

/// How often a bus is asked whether a device has left it.
const ASK_EVERY: Duration = Duration::from_millis(5);

impl App {
    /// Goes on with these settings. An error means that nothing has changed, except where it says
    /// otherwise. Not from within a runtime.
    pub fn reload(&mut self, settings: Settings, library: Library) -> anyhow::Result<()> {
        // What can fail comes before what cannot.
        let (keys, secrets) = (Keys::read(&settings)?, Secrets::read(&settings.mqtt)?);
        let old = self.plant.settings();
        let mut change = reload::compare(&old, &settings, self.circumstances(&keys));
        let port = self.http_address().map(|address| address.port());
        let listener = match reload::listens_before_leaving(&old, &settings, port) {
            Some(listen) => Some(self.runtime.block_on(Http::bind(listen))?),
            None => None,
        };
        let mut state = None;
        if change.memory {
            let names = settings.devices.iter().map(|device| device.name.as_str());
            let opened = StateFiles::open(&settings.state_dir, names)?;
            let before = self.state.now();
            change.remember_elsewhere((&old, &before.memories()), (&settings, &opened.memories()));
            state = Some(opened);
        }
        if change.is_nothing() {
            tracing::info!("the new configuration changes nothing that runs");
        }
        if change.http {
            self.exchange_http(listener, port, (&old, &settings), keys.token.clone())?;
        }
        self.exchange(&old, settings, library, state, &change)?;
        self.keys = keys;
        if change.broker {
            tracing::info!("the connection to the broker is made anew");
            self.reconnect(secrets);
        }
        self.reporter.set_configuration_error(None);
        self.plant.stir().stir();
        Ok(())
    }

    fn circumstances(&self, keys: &Keys) -> Circumstances {
        Circumstances {
            password_differs: keys.password != self.keys.password,
            token_differs: keys.token != self.keys.token,
            http_is_missing: self.http.is_none(),
        }
    }

    /// The new configuration was no good, and why; everything goes on as it was.
    pub fn refuse_reload(&self, reason: &str) {
        self.reporter.set_configuration_error(Some(reason.into()));
        self.plant.stir().stir();
    }

    /// Goes through the change in the order that [`reload`] wants: what ends ends before anything begins. `state` is
    /// where things are remembered from now on, if that is another place.
    fn exchange(
        &mut self,
        old: &Settings,
        settings: Settings,
        library: Library,
        state: Option<StateFiles>,
        change: &Change,
    ) -> anyhow::Result<()> {
        let before = old.buses.iter().map(|bus| bus.name.clone()).zip(self.plant.buses());
        let (staying, ending): (BTreeMap<_, _>, BTreeMap<_, _>) =
            before.partition(|(bus, _)| change.stays(bus));
        let _change = Reporter::change(&self.reporter);
        // Nobody asks a bus that is about to end, and takes its silence for a fault.
        self.reporter.keep(|bus| change.stays(bus));
        end_buses(&self.runtime, ending.into_values().collect());
        for (name, bus) in &staying {
            self.retire(bus, change.leaving(name));
        }
        if let Some(state) = state {
            self.state.exchange(state);
        }
        if change.telling != Telling::AsBefore {
            self.tell_otherwise(old, &settings, change.telling, staying.values());
        }
        self.plant.mailbox().change(|outbox| reload::take_back(outbox, old, &settings, change.telling));
        let buses = self.begin(&Arc::new(settings.clone()), change, staying)?;
        let watched = watched(&buses);
        self.plant.exchange(settings, library, buses);
        remember_topics(&self.plant, &self.state.now());
        self.reporter.replace(watched);
        if change.begins_telling_anew() {
            self.look_anew();
        }
        change.lines().iter().for_each(|line| tracing::info!("{line}"));
        Ok(())
    }

    /// Starts what begins, and tells every bus what is new for it. Returns all buses in the order of the settings.
    fn begin(
        &self,
        settings: &Arc<Settings>,
        change: &Change,
        mut staying: BTreeMap<String, Arc<BusHandle>>,
    ) -> anyhow::Result<Vec<Arc<BusHandle>>> {
        // What was on other buses may come to a bus only now that it has left those.
        let names = settings.devices.iter().map(|device| device.name.as_str());
        let memories = self.state.now().learn(names);
        let is_connected = self.plant.broker().connected;
        let mut buses = Vec::new();
        for (index, (name, _)) in change.buses.iter().enumerate() {
            let bus = match staying.remove(name) {
                Some(bus) => bus,
                None => self.begin_bus(settings, index)?,
            };
            for event in change.events(index, &memories, is_connected) {
                self.hand_over(&bus, event);
            }
            buses.push(bus);
        }
        Ok(buses)
    }

    fn begin_bus(&self, settings: &Arc<Settings>, index: usize) -> anyhow::Result<Arc<BusHandle>> {
        let mailbox = self.plant.mailbox();
        if let Some(message) = homeassistant::introduction_of_bus(settings, &settings.buses[index].name) {
            mailbox.push(message);
        }
        start_bus(&self.threads, settings, index, mailbox).context("the new configuration works only in part")
    }

    /// Lets the buses that stay tell what is known as the new settings want it. They lose nothing by it.
    fn tell_otherwise<'b>(
        &mut self,
        old: &Settings,
        new: &Settings,
        telling: Telling,
        staying: impl Iterator<Item = &'b Arc<BusHandle>> + Clone,
    ) {
        let mailbox = self.plant.mailbox();
        if telling == Telling::Elsewhere {
            self.leave_base_topic(old, new);
        } else {
            let wanted = reload::topics_of_devices(new);
            mailbox.change(|outbox| outbox.tell_otherwise(new, &wanted));
            if let Some(broker) = &self.broker {
                self.runtime.block_on(broker.listen_to(new));
            }
        }
        introduce(new, &mailbox);
        let wanted = bus::Telling::of(new);
        for bus in staying.clone() {
            self.hand_over(bus, Event::Telling(wanted.clone()));
        }
        for bus in staying {
            let wanted = wanted.clone();
            if !self.wait_until(bus, move |bus| bus.tells_as(&wanted)) {
                tracing::warn!("a bus does not tell in time what it knows");
            }
        }
    }

    /// Takes back everything that this gateway has told below its base topic, and leaves the broker. What is put into
    /// the mailbox from now on is for the new one.
    fn leave_base_topic(&mut self, old: &Settings, new: &Settings) {
        let mailbox = self.plant.mailbox();
        let rest = Arc::new(Mailbox::new(mailbox.exchange(plant::outbox(new)), self.plant.stir().clone()));
        let announced = rest.change(Outbox::take_back_everything);
        if let Some(broker) = self.broker.take() {
            self.runtime.block_on(broker.finish(Some(rest.clone())));
        }
        let (told_on, wanted) = (reload::topics_of_devices(old), reload::topics_of_devices(new));
        let (announced, trees) = rest.look(|outbox| outbox.legacy(announced, told_on));
        mailbox.change(|outbox| outbox.recall(announced, trees, &wanted));
    }

    /// Whoever looks at the gateway now and then takes nothing for told.
    fn look_anew(&mut self) {
        self.watch.abort();
        let _inside = self.runtime.enter();
        self.watch = tokio::spawn(watch(self.reporter.clone(), self.plant.clone(), self.state.clone()));
    }

    /// Lets devices leave a bus, and waits until the last of them has.
    fn retire(&self, bus: &BusHandle, devices: &[String]) {
        for device in devices {
            self.hand_over(bus, Event::Retire(device.clone()));
        }
        let names = devices.to_vec();
        if !self.wait_until(bus, move |bus| !names.iter().any(|name| bus.has_device(name))) {
            tracing::warn!("a device does not leave its bus in time: {}", devices.join(", "));
        }
    }

    /// Waits until the bus is so, or has ended; `false` if that takes too long.
    fn wait_until(&self, bus: &BusHandle, is_so: impl Fn(&Bus) -> bool + Clone + Send + 'static) -> bool {
        let waits = async {
            loop {
                let is_so = is_so.clone();
                let answer = bus.inspect(move |bus, _| is_so(bus));
                if answer.await.unwrap_or(true) {
                    return;
                }
                tokio::time::sleep(ASK_EVERY).await;
            }
        };
        self.runtime.block_on(async { tokio::time::timeout(BUSES_END_WITHIN, waits).await.is_ok() })
    }

    fn hand_over(&self, bus: &BusHandle, event: Event) {
        if bus.send(event).is_err() {
            tracing::error!("a bus is stuck and does not take its new configuration; restart the gateway");
        }
    }

    fn reconnect(&mut self, secrets: Secrets) {
        if let Some(broker) = self.broker.take() {
            self.runtime.block_on(broker.finish(None));
        }
        let _inside = self.runtime.enter();
        self.broker = Some(connect(&self.plant, secrets, self.clock));
    }

    /// `port` is where it listens now. An error means that it listens where it did, as far as it still can.
    fn exchange_http(
        &mut self,
        listener: Option<Bound>,
        port: Option<u16>,
        (old, new): (&Settings, &Settings),
        token: Option<String>,
    ) -> anyhow::Result<()> {
        if let Some(http) = self.http.take() {
            self.runtime.block_on(http.finish());
        }
        let bind = |listen: &str| self.runtime.block_on(Http::bind(listen));
        let bound = match (listener, &new.http.listen) {
            (Some(listener), _) => Ok(Some(listener)),
            (None, Some(listen)) => bind(listen).map(Some),
            (None, None) => Ok(None),
        };
        let (listener, failed) = match bound {
            Ok(listener) => {
                // What comes behind it may fail, and whoever then goes back has to be understood.
                self.keys.token = token;
                self.plant.set_http(new.http.clone());
                (listener, None)
            }
            Err(error) => {
                let before = reload::listened_before(old, port);
                (before.and_then(|before| bind(&before).ok()), Some(error))
            }
        };
        let token = self.keys.token.clone();
        let _inside = self.runtime.enter();
        self.http = listener.map(|listener| Http::serve(listener, self.reporter.clone(), self.clock, token));
        if let Some(address) = self.http_address() {
            tracing::info!("HTTP on http://{address}/health");
        }
        failed.map_or(Ok(()), Err)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::configuration;

    fn settings(http: &str) -> Settings {
        let text = format!(
            "mqtt: {{url: 'mqtt://localhost:1'}}\nhttp: {{{http}}}\nbuses: {{a: {{tcp: 'localhost:1'}}}}\n"
        );
        configuration::load("busker.yaml", text.as_bytes(), &Library::shipped()).expect("a good one").0
    }

    /// HTTP goes from one to the other, and nothing else does: whoever then wants the first again gets it.
    #[track_caller]
    fn check((old, first): (&str, &str), (new, second): (&str, &str)) {
        let keys = |token: &str| Keys { password: None, token: Some(token.into()) };
        let (old, new) = (settings(old), settings(new));
        let mut app = App::start(old.clone(), Library::shipped(), StateFiles::nowhere()).expect("it runs");
        app.keys = keys(first);
        app.exchange_http(None, None, (&old, &new), Some(second.into())).expect("a free port");
        let change = |wanted: &Settings, token: &str| {
            reload::compare(&app.plant.settings(), wanted, app.circumstances(&keys(token)))
        };
        assert_eq!((change(&new, second).http, change(&old, first).http), (false, true));
        app.stop();
    }

    #[test]
    fn http_goes_back_although_the_new_configuration_came_no_further_than_to_http() {
        let here = "listen: '127.0.0.1:0'";
        check((here, "first"), ("listen: 'localhost:0'", "first"));
        check((here, "first"), (&format!("{here}, token: second"), "second"));
        // In a file: the settings are the same.
        check((here, "first"), (here, "second"));
    }
}
