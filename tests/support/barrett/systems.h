#pragma once
#include <barrett/units.h>
#include <string>

namespace barrett {
namespace systems {

class System {
public:
    template <typename T> class Output {
    public:
        class Value {
        public:
            void setData(const T* value) { data = *value; }
            T data;
        };
        Output(System*, Value** value) { *value = &own; }
        Value own;
    };
    template <typename T> class Input {
    public:
        explicit Input(System* of) { managed() = of; }
        const T& getValue() const { return source->own.data; }
        Output<T>* source = nullptr;
    };
    explicit System(const std::string&) {}
    virtual ~System() {}
    void run() { operate(); }
    static System*& managed() {  // by the control loop
        static System* one = nullptr;
        return one;
    }

protected:
    void mandatoryCleanUp() {}
    virtual void operate() = 0;
};

template <typename T> void connect(System::Output<T>& from, System::Input<T>& to) {
    to.source = &from;
}

template <size_t DOF> class Wam {
    BARRETT_UNITS_TEMPLATE_TYPEDEFS(DOF);
    typename System::Output<jp_type>::Value* jpValue;
    typename System::Output<jv_type>::Value* jvValue;

public:
    System::Output<jp_type> jpOutput;
    System::Output<jv_type> jvOutput;
    System::Output<jp_type>* reference = nullptr;

    Wam() : jpOutput(nullptr, &jpValue), jvOutput(nullptr, &jvValue) {
        const double stands[] = {0.0, 0.5, 0.0, 1.5, 0.0, -1.0, 0.0};
        for (size_t i = 0; i < DOF; ++i) {
            jpValue->data[i] = stands[i];
            jvValue->data[i] = 0.0;
        }
    }
    void gravityCompensate() {}
    void idle() {}
    const jp_type& getJointPositions() const { return jpValue->data; }
    void trackReferenceSignal(System::Output<jp_type>& output) { reference = &output; }
    void move() {
        for (size_t i = 0; i < DOF; ++i) {
            const double before = jpValue->data[i];
            jpValue->data[i] = reference->own.data[i];
            jvValue->data[i] = (jpValue->data[i] - before) / 0.002;
        }
    }
};

}  // namespace systems
}  // namespace barrett
