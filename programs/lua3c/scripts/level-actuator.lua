-----

-- script do atuador (recebe a informação de nível via rede e atua na bomba)
-----

local function runPid(pid)
    error = 0
    pvD=0
    outTmp=0
    if pid.en==false then
        pid.lpv = pid.pv
        pid.fbk = 0
        pid.out = pid.lout;
    else
        pvD = pid.pv + (pid.pv - pid.lpv)*pid.td*pid.rptmin;
        pid.lpv = pid.pv
        error = pid.sp - pvD
        pid.lerror = error
        -- error = -error;
        outTmp = error * pid.k + pid.fbk;
        if (outTmp > pid.max) then
            outTmp = pid.max
        else
            if (outTmp < pid.min) then
                outTmp = pid.min
            end
        end
        pid.out = outTmp;
        pid.lout = outTmp;
        pid.fbk = pid.fbk + (outTmp-pid.fbk)*pid.resetRate/pid.rptmin;
        if pid.fbk > 100000 then
            pid.fbk = 100000
        else
            if pid.fbk < -100000 then
                pid.fbk = -100000
            end
        end
    end
end


local function getLevel(plevel)
r,id,data = n3c.rx()-- obtém o nível pela rede, enviado pelo transmissor
if r==true then
    if (id == 10) then
        plevel = data
    end
end
return plevel
end


local function getSetPoint()
v = ((h3c.aIn(2))*100)/(1023);
if v>100 then
    v = 100
end
if (v<0) then
    v = 0
end
return v
end



local function getSelectMult()
    m = 1
    if (h3c.dIn(1)==0) then
        m = 10
    end
    return m
end

idl = 10
n3c.listen(idl)

pid = {}
pid.en = true
pid.k=4.84
pid.resetRate = 4.18
pid.td = 0
pid.lout = 0
pid.fbk = 0
pid.rptmin = 60*20
pid.out = 0
pid.max = 100
pid.min = 0
pid.pv = 0
pid.lpv = 0
pid.sp = 0
pid.lerror=0
duty = 0
Lastpv = 0
pid.sp = 5

pid.en = false
lastLevel=0
lastLevel = getLevel(lastlevel)
pid.pv=lastLevel
pid.sp = getSetPoint()
runPid(pid)
duty = pid.out
h3c.aOut(2, duty)
pid.en = true

outputprint = 0;
while true do
    lastlevel = getLevel(lastlevel)
    pid.pv=lastlevel
    pid.sp = getSetPoint()
    runPid(pid)
    o3c.dms(50)
    if (duty ~= pid.out) then
        duty = pid.out
        h3c.aOut(2, duty)
    end
    outputprint = outputprint + 1
    if outputprint == 3 then
        print(pid.sp .. ' .. pid.pv .. ' .. pid.out .. ' .. pid.k .. ' .. pid.resetRate .. '\r')
        outputprint = 0
    end

    if (h3c.dIn(2)==0) then
        pid.k = pid.k + 0.2*getSelectMult()
        o3c.dms(50)
        while (h3c.dIn(2)==0) do
            end
        end

    if (h3c.dIn(3)==0) then
        pid.k = pid.k - 0.2*getSelectMult()
        if (pid.k<0) then



    pid.k = 0
end
o3c.dms(50)
while (h3c.dIn(3)==0) do
end
end

if (h3c.dIn(4)==0) then
pid.resetRate = pid.resetRate + 0.1*getSelectMult()
o3c.dms(50)
while (h3c.dIn(4)==0) do
end
end

if (h3c.dIn(5)==0) then
pid.resetRate = pid.resetRate - 0.1*getSelectMult()
if pid.resetRate<0 then
pid.resetRate = 0
end
o3c.dms(50)
while (h3c.dIn(5)==0) do
end
end
end
