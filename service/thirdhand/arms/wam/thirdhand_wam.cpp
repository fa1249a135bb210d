// Runs on the computer of a Barrett WAM, beside `thirdhand follow wam`: joint positions arrive by
// UDP at 500 Hz and become the reference of libbarrett's own position control, whose torque limits
// and safety module stay as they are; measured joints go back to the sender in each cycle.
//
//     ./thirdhand_wam [PORT]
//
// It was compiled against a stand-in for libbarrett, and never run on a WAM. A binary that is linked
// with libbarrett is under the GPL, version 3; this source is under thirdhand's licence.
//
// Packets are little endian. A command: "THWC", a number that grows (uint32), positions [rad] and
// velocities [rad/s] (doubles, one of each for a joint); with the number 0 it asks for states alone,
// and holds the joints' lower and upper limits. A state: "THWS", a number that grows (uint32), the
// time [s] (double), positions and velocities.

#include <barrett/units.h>
#include <barrett/systems.h>
#include <barrett/products/product_manager.h>
#include <barrett/standard_main_function.h>

#include <arpa/inet.h>
#include <cerrno>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <string>
#include <sys/socket.h>
#include <unistd.h>

using namespace barrett;

const int DEFAULT_PORT = 5710;
const double PERIOD_S = 0.002;         // of libbarrett's control loop
const int SILENT_CYCLES = 10;          // 20 ms without a command: the arm brakes
const double START_RAD = 0.05;         // a motion begins this near to where the arm stands
const double MOST_RADPS = 3.0;         // a faster reference is refused
const double BRAKE_RADPS2 = 6.0;       // deceleration of each joint when commands end

template <size_t DOF>
class Bridge : public systems::System {
    BARRETT_UNITS_TEMPLATE_TYPEDEFS(DOF);

public:
    Input<jp_type> jpInput;
    Input<jv_type> jvInput;
    Output<jp_type> output;

    Bridge(int port, const jp_type& stands)
        : systems::System("thirdhand"), jpInput(this), jvInput(this), output(this, &outputValue),
          reference(stands) {
        for (size_t i = 0; i < DOF; ++i) {
            velocity[i] = 0.0;
            lower[i] = upper[i] = stands[i];
        }
        server = socket(AF_INET, SOCK_DGRAM, 0);
        sockaddr_in here = sockaddr_in();
        here.sin_family = AF_INET;
        here.sin_port = htons(port);
        here.sin_addr.s_addr = htonl(INADDR_ANY);
        if (server < 0 || bind(server, reinterpret_cast<sockaddr*>(&here), sizeof here) != 0) {
            std::cerr << "UDP port " << port << " cannot be used: " << strerror(errno) << std::endl;
            std::exit(1);
        }
    }

    virtual ~Bridge() {
        this->mandatoryCleanUp();
        close(server);
    }

protected:
    typename Output<jp_type>::Value* outputValue;

    virtual void operate() {
        const jp_type& measured = jpInput.getValue();
        receive(measured);
        if (++silent > SILENT_CYCLES) {
            follows = false;
            move(BRAKE_RADPS2 * PERIOD_S);
        } else if (silent > 1) {  // late, or lost: the motion goes on
            move(0.0);
        }
        send(measured, jvInput.getValue());
        outputValue->setData(&reference);
    }

private:
    struct Command {
        char name[4];
        uint32_t number;
        double position[DOF];
        double velocity[DOF];
    };
    struct State {
        char name[4];
        uint32_t number;
        double time_s;
        double position[DOF];
        double velocity[DOF];
    };

    // Take the newest command that arrived, if the arm can follow it from where it is.
    void receive(const jp_type& measured) {
        Command command;
        sockaddr_in from;
        socklen_t size = sizeof from;
        while (recvfrom(server, &command, sizeof command, MSG_DONTWAIT,
                        reinterpret_cast<sockaddr*>(&from), &size) == sizeof command) {
            if (std::memcmp(command.name, "THWC", 4) != 0) {
                continue;
            }
            if (command.number == 0) {  // another client begins, and tells the limits
                client = from;
                heard = 0;
                std::memcpy(lower, command.position, sizeof lower);
                std::memcpy(upper, command.velocity, sizeof upper);
            } else if (command.number > heard && follow(command, measured)) {
                heard = command.number;
                silent = 0;
            }
        }
    }

    bool follow(const Command& command, const jp_type& measured) {
        const double cycles = follows ? silent + 1 : 1;
        for (size_t i = 0; i < DOF; ++i) {
            const double from = follows ? reference[i] : measured[i];
            const double most = follows ? MOST_RADPS * PERIOD_S * cycles : START_RAD;
            const double step = std::fabs(command.position[i] - from);
            if (!(step <= most && std::fabs(command.velocity[i]) <= MOST_RADPS)) {
                return false;  // also for what is not a number
            }
        }
        for (size_t i = 0; i < DOF; ++i) {
            if (!follows && std::fabs(velocity[i]) > 0.0) {
                return false;  // still braking
            }
        }
        for (size_t i = 0; i < DOF; ++i) {
            reference[i] = command.position[i];
            velocity[i] = command.velocity[i];
        }
        follows = true;
        return true;
    }

    // Move the reference on for a cycle, slower by `less` [rad/s], and not beyond the limits.
    void move(double less) {
        for (size_t i = 0; i < DOF; ++i) {
            const double speed = std::fabs(velocity[i]);
            velocity[i] = speed > less ? velocity[i] * (speed - less) / speed : 0.0;
            const double next = reference[i] + PERIOD_S * velocity[i];
            if ((next > upper[i] && velocity[i] > 0.0) || (next < lower[i] && velocity[i] < 0.0)) {
                velocity[i] = 0.0;
            } else {
                reference[i] = next;
            }
        }
    }

    void send(const jp_type& position, const jv_type& speed) {
        State state;
        std::memcpy(state.name, "THWS", 4);
        state.number = ++cycle;
        state.time_s = PERIOD_S * cycle;
        for (size_t i = 0; i < DOF; ++i) {
            state.position[i] = position[i];
            state.velocity[i] = speed[i];
        }
        if (client.sin_port != 0) {
            sendto(server, &state, sizeof state, MSG_DONTWAIT, reinterpret_cast<sockaddr*>(&client),
                   sizeof client);
        }
    }

    int server;
    sockaddr_in client = sockaddr_in();
    jp_type reference;
    double velocity[DOF];
    double lower[DOF];
    double upper[DOF];
    uint32_t heard = 0;
    uint32_t cycle = 0;
    int silent = SILENT_CYCLES;
    bool follows = false;
};

template <size_t DOF>
int wam_main(int argc, char** argv, ProductManager& pm, systems::Wam<DOF>& wam) {
    wam.gravityCompensate();
    Bridge<DOF> bridge(argc > 1 ? std::atoi(argv[1]) : DEFAULT_PORT, wam.getJointPositions());
    systems::connect(wam.jpOutput, bridge.jpInput);
    systems::connect(wam.jvOutput, bridge.jvInput);
    wam.trackReferenceSignal(bridge.output);
    std::cout << "waiting for `thirdhand follow wam`; Shift-idle ends it" << std::endl;
    pm.getSafetyModule()->waitForMode(SafetyModule::IDLE);
    wam.idle();
    return 0;
}
