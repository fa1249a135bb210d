// The main function: it runs the control loop at 500 Hz until standard input ends.
#pragma once
#include <barrett/products/product_manager.h>
#include <barrett/systems.h>
#include <chrono>
#include <poll.h>
#include <thread>

template <size_t DOF>
int wam_main(int argc, char** argv, barrett::ProductManager& pm, barrett::systems::Wam<DOF>& wam);

int main(int argc, char** argv) {
    barrett::ProductManager pm;
    barrett::systems::Wam<7> wam;
    pm.safety.wait = [&] {
        auto due = std::chrono::steady_clock::now();
        pollfd input = {0, POLLIN, 0};
        while (poll(&input, 1, 0) == 0) {
            due += std::chrono::microseconds(2000);
            std::this_thread::sleep_until(due);
            barrett::systems::System::managed()->run();
            wam.move();
        }
    };
    return wam_main<7>(argc, argv, pm, wam);
}
