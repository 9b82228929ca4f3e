//! The radio: the station of a Wi-Fi network, which carries Ethernet frames for smoltcp.

use core::{
    convert::Infallible,
    future,
    task::{Context, Poll, Waker},
};

use embassy_net_driver::{Driver, LinkState, RxToken, TxToken};
use esp_hal::{
    peripherals::WIFI,
    time::{Duration, Instant},
};
use esp_radio::wifi::{
    AuthenticationMethodConfig, Config, Interface, WifiController, WifiError, sta::StationConfig,
};
use smoltcp::{
    phy::{self, Device, DeviceCapabilities, Medium},
    time,
    wire::EthernetAddress,
};
use ubimap_agent::flash::Wireless;
use udp_link::Station;

/// Time after an attempt to connect, or between two looks at the connection.
const INTERVAL: Duration = Duration::from_secs(1);

/// Starts the radio as a station of a network. Without a password the network is open; otherwise it has
/// WPA2.
pub(crate) fn start(
    radio: WIFI<'static>,
    wireless: &Wireless,
) -> Result<WifiController<'static>, WifiError> {
    let authentication = match wireless.password.as_str() {
        "" => AuthenticationMethodConfig::Open,
        password => AuthenticationMethodConfig::Wpa2Personal(password.try_into()?),
    };
    let station = StationConfig::default()
        .with_ssid(wireless.name.as_str().try_into()?)
        .with_authentication(authentication);
    let mut controller = WifiController::new(radio, Default::default())?;
    controller.set_config(&Config::Station(station))?;
    Ok(controller)
}

/// Connects to the network whenever it is not connected. It must be polled, since it wakes nobody.
pub(crate) async fn stay_connected(mut controller: WifiController<'static>) -> Infallible {
    loop {
        if !controller.is_connected() {
            // Whether it fails is seen in a second.
            let _ = controller.connect_async().await;
        }
        let end = Instant::now() + INTERVAL;
        future::poll_fn(|_| if Instant::now() < end { Poll::Pending } else { Poll::Ready(()) })
            .await;
    }
}

/// The station's frames.
pub(crate) struct Radio(Interface);

impl Radio {
    /// The station; it is there once.
    pub(crate) fn new() -> Self {
        Self(Interface::station())
    }
}

impl Station for Radio {
    fn address(&self) -> EthernetAddress {
        EthernetAddress(self.0.mac_address())
    }

    fn is_up(&mut self) -> bool {
        self.0.link_state(&mut unheard()) == LinkState::Up
    }
}

/// Wakes nobody, since the main loop asks by itself.
fn unheard() -> Context<'static> {
    Context::from_waker(Waker::noop())
}

impl Device for Radio {
    type RxToken<'a> = Received<<Interface as Driver>::RxToken<'a>>;
    type TxToken<'a> = ToSend<<Interface as Driver>::TxToken<'a>>;

    fn receive(&mut self, _: time::Instant) -> Option<(Self::RxToken<'_>, Self::TxToken<'_>)> {
        let (received, reply) = Driver::receive(&mut self.0, &mut unheard())?;
        Some((Received(received), ToSend(reply)))
    }

    fn transmit(&mut self, _: time::Instant) -> Option<Self::TxToken<'_>> {
        Driver::transmit(&mut self.0, &mut unheard()).map(ToSend)
    }

    fn capabilities(&self) -> DeviceCapabilities {
        let mut capabilities = DeviceCapabilities::default();
        capabilities.medium = Medium::Ethernet;
        capabilities.max_transmission_unit = self.0.capabilities().max_transmission_unit;
        capabilities
    }
}

/// A received frame.
pub(crate) struct Received<T>(T);

impl<T: RxToken> phy::RxToken for Received<T> {
    fn consume<R, F: FnOnce(&[u8]) -> R>(self, read: F) -> R {
        self.0.consume(|bytes| read(bytes))
    }
}

/// Room for a frame.
pub(crate) struct ToSend<T>(T);

impl<T: TxToken> phy::TxToken for ToSend<T> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, len: usize, write: F) -> R {
        self.0.consume(len, write)
    }
}
